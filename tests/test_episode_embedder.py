"""Episodes and goals through tiny encoders: images, touch and words become curves."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from toy_towers import PaintTowers

from touchgoal.control.features import FRONT, TACTILE_LEFT, TACTILE_RIGHT, TRUTH_CONTACT
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder, PooledEncoderConfig
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS
from touchgoal.encoders.towers.towers import OfflineTowers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.goals import GoalImage, Inputs, Modality, OwnFrame, assign_goals, parse_goal
from touchgoal.rewards.reward import Reward
from touchgoal.runtime.errors import UserError

ALL: tuple[Modality, ...] = ("image", "tactile", "text")


def recorded(n: int = 12, contact: int = 7, color: int = 200) -> Episode:
    """A square that crosses the front image; a bright blob on both gels from contact on."""
    rng = np.random.default_rng(0)
    front = np.full((n, 32, 32, 3), 60, np.uint8)
    gel = rng.integers(90, 110, (240, 320, 3), dtype=np.uint8)
    touch = np.repeat(gel[None], n, axis=0)
    touch[contact:, 80:160, 100:200] = color
    for t in range(n):
        front[t, 12:20, 2 * t : 2 * t + 8] = (color, 30, 30)
    touching = np.arange(n)[:, None] >= [contact, contact + 1]  # the left finger comes first
    frames = {FRONT: front, TACTILE_LEFT: touch, TACTILE_RIGHT: touch[:, :, ::-1].copy()}
    meta = {"object": "apple", "descriptions": ["hard and smooth", "round"], "success": True}
    return Episode({**frames, TRUTH_CONTACT: touching}, "pick the apple", meta)


@pytest.fixture(scope="module")
def embedder() -> EpisodeEmbedder:
    torch.manual_seed(0)
    towers = PaintTowers()
    config = TouchEncoderConfig.for_towers(PRESETS["tiny"], towers, "gelsight_mini", 16)
    encoder = TouchEncoder(config)
    return EpisodeEmbedder(towers, encoder)


def test_goals_from_images_and_other_episodes(embedder: EpisodeEmbedder, tmp_path: Path) -> None:
    writer = EpisodeWriter(tmp_path / "set")
    writer.append(recorded(color=160))
    writer.append(recorded())
    stored = EpisodeSet(tmp_path / "set").read(1)
    other = embedder.embed_chunks([stored], 20.0, "set#1")
    mine = embedder.embed_chunks([recorded(color=160)], 20.0, "mine")
    spec = parse_goal(f"episode:{tmp_path / 'set'}#1")
    end = embedder.embed_goal(assign_goals([spec], ALL), mine)
    for name in ("image", "touch"):
        assert end.features[name] == pytest.approx(other.features[name][-1:], abs=1e-5)

    Image.fromarray(stored.frames[FRONT][-1]).save(tmp_path / "end.png")
    end = embedder.embed_goal(assign_goals([GoalImage(tmp_path / "end.png")], ALL), mine)
    assert "touch" not in end.features
    assert end.features["image"] == pytest.approx(other.features["image"][-1:], abs=1e-5)
    (tmp_path / "end.png").write_text("no image")
    with pytest.raises(UserError, match=r"end\.png cannot be read"):
        GoalImage(tmp_path / "end.png").read()


def test_what_cannot_be_embedded_is_refused(embedder: EpisodeEmbedder) -> None:
    oil = PaintTowers("oil")
    encoder = TouchEncoder(TouchEncoderConfig.for_towers(PRESETS["tiny"], oil, "gelsight_mini", 16))
    with pytest.raises(UserError, match="trained with the towers oil, not paint"):
        EpisodeEmbedder(PaintTowers(), encoder)
    with pytest.raises(UserError, match="starts in contact"):
        embedder.embed_chunks([recorded(contact=0)], 20.0, "mine")
    early, late = (embedder.embed_chunks([recorded(contact=c)], 20.0, "mine") for c in (2, 7))
    assert early.features["touch"][[0, -1]] == pytest.approx(
        late.features["touch"][[0, -1]], abs=1e-6
    )
    touch_alone = {k: v for k, v in recorded().frames.items() if k != FRONT}
    touched = embedder.embed_chunks([replace(recorded(), frames=touch_alone)], 20.0, "mine")
    touched = embedder.describe(touched, recorded().meta)
    assert touched.modalities == ("tactile", "text") and len(touched) == 12


def test_encoders_without_words_measure_touch() -> None:
    """Learned without labels, or an ImageNet network: 0 at the goal, as far untouched as can be."""
    torch.manual_seed(0)
    goal = assign_goals([OwnFrame()], ("image", "tactile"))
    inputs = Inputs.of("mine", recorded().frames, sensor="gelsight_mini")
    for encoder in (
        TouchBackbone(TouchBackboneConfig.for_sensor(PRESETS["tiny"], "gelsight_mini")),
        PooledEncoder(PooledEncoderConfig.for_sensor("gelsight_mini")),
    ):
        embedder = EpisodeEmbedder(PaintTowers(), encoder)
        e = embedder.embed_chunks([recorded()], 20.0, "mine")
        assert embedder.describe(e, recorded().meta).modalities == ("image", "tactile")
        cost = compute_curves(e, embedder.embed_goal(goal, e), None).raw["tactile"]
        assert cost[7:] == pytest.approx(np.zeros(5), abs=1e-3)
        assert cost[0] > 0.02 and np.ptp(cost[:7]) < 1e-6
        assert e.made_with.sensor == "gelsight_mini" and e.made_with.encoder
        with pytest.raises(UserError, match="was not aligned with texts"):
            Reward("hard", encoder=encoder, towers=PaintTowers()).prepare(inputs)


def test_an_episode_embedded_in_chunks_is_the_whole(embedder: EpisodeEmbedder) -> None:
    whole = recorded(20)
    chunks = [
        replace(whole, frames={key: v[rows] for key, v in whole.frames.items()})
        for rows in (slice(12), slice(12, 13), slice(13, 20))
    ]
    once = embedder.embed_chunks([whole], 20.0, "x")
    joined = embedder.embed_chunks(chunks, 20.0, "x")
    for name, values in once.features.items():
        assert joined.features[name] == pytest.approx(values, abs=1e-5), name
    assert (joined.contact, len(joined)) == (once.contact, 20)
    frames = {key: values for key, values in whole.frames.items() if key != TRUTH_CONTACT}
    pressed = replace(whole, frames={key: values[7:] for key, values in frames.items()})
    untouched = {key: frames[key][:5] for key in (TACTILE_LEFT, TACTILE_RIGHT)}
    apart = embedder.embed_chunks([pressed], 20.0, "x", untouched)
    assert apart.contact.frame == 0
    for name, values in apart.features.items():
        if name != "slip":  # counts from the first frame
            assert values == pytest.approx(once.features[name][7:], abs=1e-5), name


def test_noise_compression_and_size_of_a_camera_hardly_move_what_is_seen() -> None:
    image = cv2.circle(np.full((256, 256, 3), 90, np.uint8), (120, 130), 60, (30, 60, 200), -1)
    noisy = np.clip(image + np.random.default_rng(0).normal(0, 2, image.shape), 0, 255)
    sent = np.asarray(cv2.imdecode(cv2.imencode(".jpg", noisy.astype(np.uint8))[1], 1))
    small = cv2.resize(image, (128, 128), interpolation=cv2.INTER_AREA)
    camera = EpisodeEmbedder(towers := OfflineTowers(), None)
    [seen], [received] = (camera.embed_cameras({FRONT: i[None]})["front"] for i in (small, sent))
    raw = torch.cosine_similarity(towers.embed_images(small[None]), towers.embed_images(sent[None]))
    assert 1 - seen @ received < 0.02 < 0.08 < 1 - float(raw)

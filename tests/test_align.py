"""Alignment training and its retrieval metrics, at toy size."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from toy_towers import PaintTowers, TogetherTowers

from touchgoal.encoders.alignment.align import AlignedBatch, align, batch_losses
from touchgoal.encoders.alignment.config import ALIGN_PRESETS, AlignConfig, Augmentation
from touchgoal.encoders.alignment.data import TouchData, prepare_touch_data, split_by_episode
from touchgoal.encoders.alignment.retrieval import evaluate_retrieval, mean_average_precision, top1
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.vit import PRESETS as PRESETS_VIT
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.touches import Touches
from touchgoal.runtime.errors import UserError

DESCRIPTIONS = {
    "ball": ["a hard round ball", "round and firm", "a smooth sphere"],
    "brush": ["bristles", "many fine hairs", "a scratchy brush"],
    "cloth": ["a soft woven cloth", "soft", "loose threads crossing"],
}
CONFIG = AlignConfig(backbone="vit-tiny", embedding_dim=16, epochs=3, batch_size=16, lr=3e-3)
SENSOR, FRESH = "gelsight_mini", TrainerOptions()


def run_align(
    train: Touches,
    val: Touches,
    config: AlignConfig,
    out_dir: Path,
    options: TrainerOptions = FRESH,
) -> TouchEncoder:
    return align(train, val, PaintTowers(), config, SENSOR, out_dir, options, {})


def make_touches(per_episode: int, seed: int, per_object: int = 1) -> Touches:
    """Episodes of each object; a third of the touches is without contact; each has its own dent."""
    rng = np.random.default_rng(seed)
    names = [name for name in DESCRIPTIONS for _ in range(per_object)]
    frames, objects, episode = [], [], []
    background = np.full((60, 80, 3), 100, np.uint8)
    y, x = np.mgrid[:60, :80]
    for e in range(len(names)):
        for i in range(per_episode):
            frame = background + rng.normal(0, 1, (60, 80, 3))
            if i % 3:
                place, radius = rng.uniform((15, 15), (45, 65)), (4, 8, 16)[e // per_object]
                distance2 = (y - place[0]) ** 2 + (x - place[1]) ** 2
                frame[:, :, e // per_object] += 60 * np.exp(-distance2 / radius**2)
            frames.append(frame.round().astype(np.uint8))
            objects.append(names[e] if i % 3 else "")
            episode.append(e)
    colours = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200]]).repeat(per_object, 0)
    view = np.broadcast_to(colours[:, None, None], (len(names), 16, 16, 3)).astype(np.uint8)
    return Touches(
        frames=np.stack(frames),
        background=np.stack([background] * len(names)),
        background_index=np.array(episode),
        view=view,
        view_index=np.array(episode),
        object=tuple(objects),
        descriptions=DESCRIPTIONS,
    )


TRAIN, VAL = make_touches(12, 0), make_touches(6, 1, per_object=4)


def test_prepared_data_pairs_touch_with_object_and_view() -> None:
    data = prepare_touch_data(TRAIN, PaintTowers(), "gelsight_mini", CONFIG.no_contact_texts)
    assert data.names == ("", "ball", "brush", "cloth")
    assert [data.names[i] for i in data.label] == list(TRAIN.object)
    assert data.contact.tolist() == [name != "" for name in TRAIN.object]
    assert data.touch.shape == (36, 3, 120, 160)
    assert data.describes.sum(1).tolist() == [len(CONFIG.no_contact_texts), 3, 3, 3]
    noise = BatchNoise(torch.Generator().manual_seed(0))
    drawn = [data.draw_sentences(torch.arange(36), noise) for _ in range(2)]
    assert not torch.equal(*drawn) and data.describes[data.label, drawn[0]].all()
    with pytest.raises(UserError, match="'brush' has no descriptions"):
        unnamed = replace(TRAIN, descriptions={"ball": ["round"]})
        prepare_touch_data(unnamed, PaintTowers(), SENSOR, CONFIG.no_contact_texts)


def test_paper_preset_is_equation_2_and_the_default_adds_image_to_text() -> None:
    generator, label = torch.Generator().manual_seed(0), torch.tensor([0, 0, 1, 1, 2, 3])
    touch, text, image = F.normalize(torch.randn(3, 6, 8, generator=generator), dim=2)
    batch = AlignedBatch(touch, text, image, label != 0, label[:, None] == label)
    c = batch.contact
    paper = batch_losses(batch, True, ALIGN_PRESETS["paper"])
    image = (batch.touch[c] @ batch.image[c].T / 0.2).log_softmax(1).diagonal().mean()
    text = (batch.touch @ batch.text.T / 0.2).log_softmax(1).diagonal().mean()
    torch.testing.assert_close(paper["loss"], -image - text)
    three = batch_losses(batch, False, replace(CONFIG, text_weight=0.5))
    weighted = 0.5 * three["loss_touch_text"] + three["loss_image_text"]
    torch.testing.assert_close(three["loss"], weighted + three["loss_touch_image"])


def test_one_batch_can_be_learned_by_heart(tmp_path: Path) -> None:
    # 60 touches: every epoch is a single step
    touches = make_touches(5, 0, per_object=4)
    config = replace(CONFIG, epochs=40, batch_size=64, augmentation=Augmentation(), mask_ratio=0.0)
    encoder = run_align(touches, touches, config, tmp_path)
    history = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    best = max(m["touch_to_text_map"] + m["touch_to_image_map"] for m in history)
    assert best > 1.98
    assert history[-1]["touch_to_text_top1"] == history[-1]["touch_to_image_top1"] == 1
    assert history[-1]["contact_accuracy"] == 1
    # a touch cannot know which of its object's sentences is drawn, hence the wider margin
    for modality, margin in (("text", 0.3), ("image", 0.1)):
        loss, floor = (history[-1][f"touch_to_{modality}_{k}"] for k in ("loss", "floor"))
        assert floor - 1e-4 <= loss < floor + margin
    text = encoder.embed_text_goal(["a hard round ball", "a soft woven cloth"], PaintTowers())
    ball = encoder.embed_frames(touches.frames[1:2], touches.background[0])
    assert (ball @ text[0]).item() > (ball @ text[1]).item() + 0.2


def test_paper_preset_runs_with_towers_pretrained_together(tmp_path: Path) -> None:
    paper = replace(ALIGN_PRESETS["paper"], backbone="vit-tiny", epochs=1, batch_size=8)
    encoder = align(TRAIN, VAL, TogetherTowers(), paper, SENSOR, tmp_path, FRESH, {})
    assert encoder.config.embedding_dim == 48 and isinstance(encoder.image_head, torch.nn.Identity)
    metrics = json.loads((tmp_path / "metrics.jsonl").read_text())
    assert metrics["touch_to_image_loss"] >= metrics["touch_to_image_floor"] - 1e-4
    assert "contact_accuracy" not in metrics


def as_felt(view: torch.Tensor, label: torch.Tensor) -> tuple[TouchEncoder, TouchData]:
    """Return data in which each touch is embedded as its own episode's view."""
    n, names = len(view), ("a", "b")
    data = TouchData(
        touch=torch.zeros(n, 3, 1, 1).half(),
        label=label,
        contact=torch.ones(n, dtype=torch.bool),
        view_index=torch.arange(n),
        images=view,
        texts=torch.eye(2, view.shape[1]),
        describes=torch.eye(2, dtype=torch.bool),
        names=names,
    )
    config = TouchEncoderConfig.for_towers(PRESETS_VIT["tiny"], PaintTowers(), SENSOR, 16)
    encoder = TouchEncoder(config)
    encoder.embed_touch = lambda touch, ids_keep=None: view
    encoder.project_text = encoder.project_image = lambda embeddings: embeddings
    return encoder, data


def test_a_touch_does_not_find_the_view_of_its_own_episode() -> None:
    """Every touch knows its own episode again, and nothing of its object."""
    view, label = torch.eye(6), torch.tensor([0, 0, 0, 1, 1, 1])
    metrics = evaluate_retrieval(*as_felt(view, label))
    assert metrics["touch_to_image_map"] == pytest.approx(metrics["chance_image_map"])
    assert (metrics["touch_to_image_top1"] or 0) <= 0.5
    assert evaluate_retrieval(*as_felt(view[:2], label[2:4]))["touch_to_image_map"] is None


def test_halves_share_objects_but_no_episodes() -> None:
    data = prepare_touch_data(VAL, PaintTowers(), SENSOR, CONFIG.no_contact_texts)
    one, other = split_by_episode(data, seed=0)
    assert len(one) + len(other) == len(data)
    assert not set(one.view_index.tolist()) & set(other.view_index.tolist())
    assert one.label.unique().tolist() == other.label.unique().tolist() == [0, 1, 2, 3]
    assert torch.equal(split_by_episode(data, seed=0)[0].view_index, one.view_index)


def test_average_precision_by_hand() -> None:
    similarity = np.array([[0.9, 0.8, 0.7, 0.6]])
    relevant = np.array([[True, False, True, False]])
    assert mean_average_precision(similarity, relevant) == pytest.approx((1 + 2 / 3) / 2)


def test_ties_count_as_their_expectation() -> None:
    rng = np.random.default_rng(0)
    similarity = rng.integers(0, 3, (1, 12)).astype(float)
    relevant = rng.random((1, 12)) < 0.4
    jittered = similarity + 1e-6 * rng.random((20_000, 12))
    simulated = mean_average_precision(jittered, relevant.repeat(20_000, 0))
    assert mean_average_precision(similarity, relevant) == pytest.approx(simulated, abs=3e-3)
    label = torch.arange(3).repeat_interleave(5)
    assert top1(torch.ones(15, 3), label) == pytest.approx(1 / 3), "a collapsed encoder"

"""What trainings read: folders of touch without labels, none of it held out; what makes data unfit."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from published_files import encoded, gel, write
from toy_episodes import FPS, make_episode
from toy_policies import TOY, toy_observations

from touchgoal.control import features as ft
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS, ViTConfig
from touchgoal.encoders.ssl.unlabelled_touch import open_touch
from touchgoal.episodes.media import write_video
from touchgoal.episodes.overlap import require_no_shared_frames
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.network import PolicyNetwork
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.runtime.errors import UserError

SPLITS = "train", "unlabelled", "val", "test"


def press(brightness: int) -> np.ndarray:
    """Nine images of a Mini: untouched five times, then with a square as bright as that."""
    images = np.full((9, 60, 80, 3), 100, np.uint8)
    images[5:, 20:40, 30:50] = brightness
    return images


def write_videos(folder: Path, splits: tuple[str, ...] = SPLITS, brightness: int = 180) -> Path:
    """Write one video per split: held-out ones darken when touched, the others brighten."""
    (folder / "videos").mkdir(parents=True)
    with (folder / "labels.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow("file object name split hardness roughness bumpiness".split())
        for split in splits:
            images = press(20 if split in ("val", "test") else brightness)
            write_video(folder / "videos" / f"{split}.mp4", images, 10)
            rows.writerow([f"{split}.mp4", split, split, split, "", "", ""])
    return folder


def pressed_up(touch: torch.Tensor) -> np.ndarray:
    """Which touches are brighter than the untouched sensor and which darker: +1, 0, -1."""
    mean = touch.float().flatten(1).mean(1).numpy()
    return np.where(np.abs(mean) < 0.005, 0, np.sign(mean))


def test_held_out_videos_are_judged_by_and_not_learned_from(tmp_path: Path) -> None:
    touch = open_touch([write_videos(tmp_path / "videos")], (), None)
    train, judged = (draw(9, 0, (0,)) for draw in (touch.train, touch.validation))
    assert train.sensor == "gelsight_mini" and len(train) == len(judged) == 18
    assert set(pressed_up(train.touch)) == {0, 1} and set(pressed_up(judged.touch)) == {0, -1}
    moments = touch.train(9, 0, (0, 2))
    assert moments.touch.shape[:2] == (18, 2) and moments.stride == 2


def test_several_folders_are_learned_from_together(tmp_path: Path) -> None:
    videos = write_videos(tmp_path / "videos")
    for i in (1, 2, 3):  # ObjectFolder's layout: the last is held out
        write(tmp_path / "pickles" / f"{i:03d}.pkl", [encoded(gel(i, (240, 320)))])
    touch = open_touch([videos, tmp_path / "pickles"], (), "gelsight_mini")
    assert len(touch.train(9, 0, (0,))) == 18 + 2
    assert len(touch.validation(9, 0, (0,))) == 18 + 1
    elsewhere = write_videos(tmp_path / "others", ("train", "unlabelled"), brightness=150)
    assert len(open_touch([videos], [elsewhere], None).validation(9, 0, (0,))) == 18 + 18


def test_shared_frames_are_refused_whatever_the_folder_and_the_order(tmp_path: Path) -> None:
    videos = write_videos(tmp_path / "videos", ("train",))
    copies = write_videos(tmp_path / "copies", ("unlabelled", "test"))
    with pytest.raises(UserError, match="unlabelled.mp4.* shares .* frames with .*train.mp4"):
        open_touch([videos], [copies], None)
    rows = [encoded(gel(i, (240, 320))) for i in range(4)]
    other = [[encoded(gel(i, (240, 320)))] for i in range(7, 10)]
    for name, clips in (("a", [rows, *other[:2]]), ("b", [other[2], rows[::-2]])):
        for i, clip in enumerate(clips):
            write(tmp_path / name / f"{i:03d}.pkl", clip)
    with pytest.raises(UserError, match="001.pkl.* shares 2 frames with .*000.pkl"):
        open_touch([tmp_path / "a"], [tmp_path / "b"], "gelsight_mini")


def write_set(root: Path, episodes: list[Episode]) -> EpisodeSet:
    writer = EpisodeWriter(root, FPS)
    for episode in episodes:
        writer.append(episode)
    return EpisodeSet(root)


def part(episode: Episode, keys: tuple[str, ...], rows: slice = slice(None)) -> Episode:
    return Episode({key: episode.frames[key][rows] for key in keys}, episode.task)


@pytest.mark.parametrize(
    "keys", [(ft.STATE, ft.ACTION), (ft.TACTILE_LEFT,)], ids=["state", "touch"]
)
def test_validation_frames_that_are_trained_on_are_refused(tmp_path: Path, keys) -> None:
    whole = [part(make_episode(seed, 20), keys) for seed in range(4)]
    train = write_set(tmp_path / "a", whole[:3])
    require_no_shared_frames(train, write_set(tmp_path / "b", whole[3:]))
    reordered = [whole[3], part(make_episode(1, 20), keys, slice(None, None, -2))]
    with pytest.raises(UserError, match="episode 1 of .* shares 10 frames with episode 1 of"):
        require_no_shared_frames(train, write_set(tmp_path / "c", reordered))


def test_a_common_resting_start_is_no_overlap(tmp_path: Path) -> None:
    episodes = [part(make_episode(seed, 40), (ft.STATE, ft.ACTION)) for seed in range(2)]
    for episode in episodes:
        episode.frames[ft.STATE][:15] = 0.5
    train, validation = (write_set(tmp_path / str(i), [e]) for i, e in enumerate(episodes))
    require_no_shared_frames(train, validation)


STRIDE = 3
PAIR = replace(PRESETS["tiny"], channels=6)
CLIP = replace(PRESETS["tiny"], width=48, tubelet=2, frames=4)


def backbone(vit: ViTConfig) -> TouchBackbone:
    torch.manual_seed(0)
    return TouchBackbone(TouchBackboneConfig.for_sensor(vit, "gelsight_mini", STRIDE)).eval()


@pytest.mark.parametrize("vit", [PRESETS["tiny"], PAIR, CLIP], ids=["one", "two", "clip"])
@pytest.mark.parametrize("real_time", [False, True])
def test_a_policy_feels_what_its_training_did(vit: ViTConfig, real_time: bool) -> None:
    """Also between plans: the past holds observed frames, not embedded ones."""
    touch, ticks = TouchEmbedder(backbone(vit), "toy"), toy_observations(14)
    config = replace(TOY, touch_dim=touch.dim, execution_horizon=4)
    planner, embedded = LearnedPolicy(PolicyNetwork(config).eval(), touch), {}
    embed = planner._embed_touch

    def watched(history):
        rows = embed(history)
        embedded[float(history[-1][ft.STATE][0])] = rows
        return rows

    planner._embed_touch = watched
    actor = RealTimeActor(planner, timeout=10.0) if real_time else planner
    for tick in ticks:
        actor.act(dict(tick))
    if isinstance(actor, RealTimeActor):
        actor.close()
    frames = {key: np.stack([tick[key] for tick in ticks]) for key in ft.TACTILE}
    sides = [touch.encoder.embed_frames(frames[key], frames[key][0]) for key in ft.TACTILE]
    recorded = np.concatenate(sides, 1)
    known = {float(tick[ft.STATE][0]): i for i, tick in enumerate(ticks)}
    assert len(embedded) >= 6 and max(known[key] for key in embedded) > 2 * STRIDE
    for key, rows in embedded.items():
        np.testing.assert_allclose(rows, recorded[known[key]], atol=1e-5)

"""What trainings without labels learn from: several folders of several kinds, none of it held out."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from published_files import encoded, gel, write, write_slides

from touchgoal.encoders.ssl.config import DINO_PRESETS
from touchgoal.encoders.ssl.unlabelled_touch import open_touch
from touchgoal.episodes.media import write_video
from touchgoal.launch.__main__ import read_options
from touchgoal.runtime.errors import UserError

SPLITS = "train", "unlabelled", "val", "test"


def press(brightness: int) -> np.ndarray:
    """Nine pictures of a Mini: untouched five times, then with a square as bright as that."""
    pictures = np.full((9, 60, 80, 3), 100, np.uint8)
    pictures[5:, 20:40, 30:50] = brightness
    return pictures


def write_videos(folder: Path, splits: tuple[str, ...] = SPLITS, brightness: int = 180) -> Path:
    """One video of each split: the held-out ones are darker than untouched, the others brighter."""
    (folder / "videos").mkdir(parents=True)
    with (folder / "labels.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow("file object name split hardness roughness bumpiness".split())
        for split in splits:
            write_video(
                folder / "videos" / f"{split}.mp4",
                press(20 if split in ("val", "test") else brightness),
                10,
            )
            rows.writerow([f"{split}.mp4", split, split, split, "", "", ""])
    return folder


def pressed_up(touch: torch.Tensor) -> np.ndarray:
    """Which touches are brighter than the untouched sensor and which darker: +1, 0, -1."""
    mean = touch.float().mean(dim=(1, 2, 3)).numpy()
    return np.where(np.abs(mean) < 0.005, 0, np.sign(mean))


def test_held_out_videos_are_judged_by_and_not_learned_from(tmp_path: Path) -> None:
    touch = open_touch([write_videos(tmp_path / "videos")], (), None)
    train, judged = (draw(9, 0, None) for draw in (touch.train, touch.validation))
    assert train.sensor == "gelsight_mini" and len(train) == len(judged) == 18
    assert set(pressed_up(train.touch)) == {0, 1} and set(pressed_up(judged.touch)) == {0, -1}
    moments = touch.train(9, 0, (0, 2))
    assert moments.touch.shape[:2] == (18, 2) and moments.stride == 2
    facts = {"path": str(tmp_path / "videos"), "recordings": 2, "held_out": 2}
    assert touch.recipe["data"] == {"train": [facts], "validation": []}


def test_several_folders_are_learned_from_together(tmp_path: Path) -> None:
    videos = write_videos(tmp_path / "videos")
    for i in (1, 2, 3):  # ObjectFolder's layout: the last is held out
        write(tmp_path / "pickles" / f"{i:03d}.pkl", [encoded(gel(i, (240, 320)))])
    touch = open_touch([videos, tmp_path / "pickles"], (), "gelsight_mini")
    assert len(touch.train(9, 0, None)) == 18 + 2
    assert len(touch.validation(9, 0, None)) == 18 + 1
    elsewhere = write_videos(tmp_path / "others", ("train", "unlabelled"), brightness=150)
    assert len(open_touch([videos], [elsewhere], None).validation(9, 0, None)) == 18 + 18


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


def test_what_cannot_be_learned_from_together_is_one_line(tmp_path: Path) -> None:
    videos = write_videos(tmp_path / "videos")
    write_slides(tmp_path / "slides", ("mug",))
    with pytest.raises(UserError, match="slides was recorded with digit, not gelsight_mini"):
        open_touch([videos, tmp_path / "slides"], (), None)
    with pytest.raises(UserError, match="was recorded with gelsight_mini, not digit"):
        open_touch([videos], (), "digit")
    with pytest.raises(UserError, match="videos holds no recordings out: .* --validation"):
        open_touch([write_videos(tmp_path / "a" / "videos", ("train",))], (), None)
    with pytest.raises(UserError, match="has no video to train on: .* train or unlabelled"):
        open_touch([write_videos(tmp_path / "held", ("val",))], (), None)
    with pytest.raises(UserError, match="leave --validation out"):
        open_touch([videos], [tmp_path / "slides" / ".." / "videos"], None)


def test_a_preset_sets_defaults_that_options_override() -> None:
    words = ["dino", "--data", "x", "--preset", "paper", "--dino.epochs", "3"]
    _, config = read_options("train-encoder", words)
    assert config.dino == replace(DINO_PRESETS["paper"], epochs=3)
    _, config = read_options("train-encoder", ["dino", "--data", "x"])
    assert config.dino == DINO_PRESETS["default"]

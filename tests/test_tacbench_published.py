"""TacBench on published files: the samples made of them, and the table they lead to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from published_files import gel, write_force_batch, write_grasps, write_pose_set

from touchgoal.benchmarks.papers.tacbench import published_recordings
from touchgoal.benchmarks.papers.tacbench.benchmark import run
from touchgoal.benchmarks.papers.tacbench.config import Config
from touchgoal.benchmarks.papers.tacbench.pose import PoseTask
from touchgoal.benchmarks.papers.tacbench.published_recordings import (
    find_published,
    read_published_strokes,
)
from touchgoal.benchmarks.papers.tacbench.task import split_force, split_grasp
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.episodes.importers.tacbench_poses import read_bags
from touchgoal.runtime.errors import UserError

DIGIT, GELSIGHT = preprocessor_for("digit"), preprocessor_for("gelsight")


def write_probes(folder: Path, strokes: int) -> None:
    for probe in ("sphere", "sharp", "flat"):
        write_force_batch(folder / probe / "batch_1", strokes=strokes)


def test_strokes_become_samples_with_their_own_background(tmp_path: Path) -> None:
    write_probes(tmp_path, strokes=6)
    frames = read_published_strokes(tmp_path, "digit", 15, DIGIT)
    assert sorted(np.unique(frames.indenter)) == ["flat", "sharp", "sphere"]
    assert len(np.unique(frames.stroke)) == 15 and len(frames.touch) == 15 * 6
    assert frames.before[:7].tolist() == [0, 0, 0, 0, 0, 0, 6]
    assert frames.force[5].tolist() == pytest.approx([0.9, 0.3, 3.0])
    assert frames.slip[:6].tolist() == [False] * 4 + [True] * 2
    plain = np.full((320, 240, 3), (150, 120, 90), np.uint8)
    expected = torch.from_numpy(DIGIT(gel(3)[None], plain))[0].half()  # of the first stroke, flat
    assert torch.equal(frames.touch[3], expected)
    split = split_force(frames)
    assert set(frames.indenter[split.train.numpy()]) == {"sphere", "sharp"}
    assert set(frames.indenter[split.tests["flat probe, unseen"].numpy()]) == {"flat"}


def test_bags_become_classes_of_their_motions(tmp_path: Path) -> None:
    write_pose_set(tmp_path, bags=5, pictures=14, shape=(32, 24))
    published = find_published(tmp_path, "gelsight_mini")
    assert published is not None and published.sensor == "digit" and published.what == "slides"
    frames = published.read(20, DIGIT)
    task = PoseTask(frames)
    changes = np.stack([bag.change for bag in read_bags(tmp_path)])
    used = torch.cat([task.split.train, task.split.validation, *task.split.tests.values()])
    bounds = np.array([-5, -2, -1, -0.5, -0.1, 0.1, 0.5, 1, 2, 5])
    for row in used.tolist():
        bag, moment = divmod(row, 14)
        assert moment >= 10  # before that the motion, or the past, is not known
        right = np.searchsorted(bounds, 1e3 * changes[bag, moment, 0], side="right")
        assert task.classes[row, 0] == right
    assert len(used) == 20 * 4
    bags = np.unique(frames.stroke[task.split.tests["known objects"].numpy()])
    assert bags.tolist() == list(range(10, 20))  # the published test bags
    assert np.unique(frames.stroke[task.split.validation.numpy()]).tolist() == [4, 9]


def test_of_a_long_recording_the_middle_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(published_recordings, "_LONGEST", 12)
    write_pose_set(tmp_path, bags=1, pictures=18, shape=(32, 24))
    published = find_published(tmp_path, "digit")
    assert published is not None
    frames = published.read(4, DIGIT)
    assert len(frames.touch) == 4 * 12 and frames.pose is not None
    motion = (frames.pose - frames.pose[frames.before]).numpy()
    for i, bag in enumerate(read_bags(tmp_path)):
        expected = bag.change[8:15] * (1e3, 1e3, 180 / np.pi)
        assert np.allclose(motion[12 * i + 5 : 12 * i + 12], expected, atol=1e-3)


def test_grasps_are_pairs_of_moments(tmp_path: Path) -> None:
    write_grasps(tmp_path / "000.pkl", [True, False] * 6)
    write_grasps(tmp_path / "030.pkl", [True, False])
    published = find_published(tmp_path, "gelsight_mini")
    assert published is not None and published.sensor == "gelsight"
    frames = published.read(14, GELSIGHT)
    assert len(frames.touch) == 14 * 2 * 3 and frames.before[:6].tolist() == [0, 0, 1, 3, 3, 4]
    split = split_grasp(frames)
    tested = torch.cat(list(split.tests.values()))
    assert np.unique(frames.stroke[tested.numpy()]).tolist() == [12, 13]
    assert frames.label is not None and frames.label[tested].sum() == len(tested) / 2


def test_the_benchmark_takes_published_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_probes(tmp_path / "files", strokes=5)
    options = Config(
        tasks=("force", "slip"),
        encoders=("end-to-end:tiny",),
        shares=(1.0,),
        data=tmp_path / "files",
        strokes=15,
        seeds=1,
        end_to_end_steps=2,
        end_to_end_batch_size=4,
        workers=1,
    )
    before = sorted((tmp_path / "files").rglob("*"))
    result = run(options)
    assert {row["task"] for row in result["rows"]} == {"force", "slip"}
    assert f"published files in {tmp_path / 'files'}: digit" in result["table"]
    assert sorted((tmp_path / "files").rglob("*")) == before  # nothing is written there
    with pytest.raises(UserError, match="is not for pose: choose --tasks force slip"):
        run(replace(options, tasks=("force", "pose")))
    with pytest.raises(UserError, match="is for gelsight_mini_markers, "):
        run(replace(options, encoders=("gelsight_mini_markers",)))

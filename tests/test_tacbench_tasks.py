"""TacBench's other tasks (grasps, cloths, fields) and the published ones, at toy size."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from published_files import gel, write_force_batch, write_pose_set

from touchgoal.benchmarks.papers.tacbench.benchmark import run
from touchgoal.benchmarks.papers.tacbench.config import Config
from touchgoal.benchmarks.papers.tacbench.data import read_cloths, read_grasps
from touchgoal.benchmarks.papers.tacbench.force import field_metrics
from touchgoal.benchmarks.papers.tacbench.labels import grasp_task, label_metrics, textile_task
from touchgoal.benchmarks.papers.tacbench.pose import PoseTask
from touchgoal.benchmarks.papers.tacbench.published_recordings import (
    find_published,
    read_published_strokes,
)
from touchgoal.benchmarks.papers.tacbench.task import split_force, split_grasp
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.episodes.bench_recording import record_bench
from touchgoal.episodes.importers.tacbench_poses import read_bags
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cloths import CLOTHS, FRAMES, press_cloth
from touchgoal.sim_envs.config import RigConfig
from touchgoal.sim_envs.grasp_rig import GraspAttempt, attempt_grasp
from touchgoal.sim_envs.indenter_rig import REST, rig_unit, simulate

RIG = RigConfig(seed=3)
GRASPS = 5


@pytest.fixture(scope="session")
def grasps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("grasps")
    record_bench("grasps", folder, RIG, GRASPS, workers=1)
    return folder


def test_the_field_over_the_picture_adds_up_to_the_force() -> None:
    stroke, unit = simulate(RIG, 1), rig_unit(RIG)
    rows, columns = find_sensor(RIG.sensor).image_shape
    cell = rows * columns * unit.pixel_pitch**2 / 24**2
    force = 1e3 * cell * stroke.field.sum((2, 3))
    assert not stroke.field[:REST].any()
    np.testing.assert_allclose(force, stroke.wrench[:, :3] * [1, 1, -1], atol=0.02, rtol=0.01)


def held(attempt: GraspAttempt) -> bool | None:
    """Return whether friction alone must hold the object; None where it is close."""
    friction, weight = attempt.body.kind.material.friction, 9.81 * attempt.body.mass
    share = 2 * friction * attempt.grip / weight
    return True if share > 4 else False if share < 0.6 else None


def test_a_grasp_holds_as_friction_says() -> None:
    sure = 0
    for index in (2, 4, 5, 7, 8):
        attempt = attempt_grasp(RIG, index)
        expected = held(attempt)
        sure += expected is not None
        assert expected is None or attempt.held == expected
        assert not attempt.wrench[0].any()
        grips = -attempt.wrench[1, [2, 8]]
        assert grips.sum() == pytest.approx(2 * attempt.grip, rel=0.1)
        if attempt.held:  # what hangs pulls both pads down: their x is down
            down = attempt.wrench[2, 0] + attempt.wrench[2, 6]
            assert down > attempt.wrench[1, 0] + attempt.wrench[1, 6]
    assert sure >= 2


def test_grasps_are_pairs_of_moments_of_each_finger(grasps: Path) -> None:
    episodes = record_bench("grasps", grasps, RIG, GRASPS, workers=1)
    frames = read_grasps(episodes, GRASPS, preprocessor_for(RIG.sensor))
    assert len(frames.stroke) == GRASPS * 2 * 3
    assert frames.before[:6].tolist() == [0, 0, 1, 3, 3, 4]
    again = attempt_grasp(RIG, 1)
    assert frames.label is not None and frames.label[6:12].tolist() == 6 * [int(again.held)]
    split = split_grasp(frames)
    assert set(split.tests) == {"gripped", "lifted"}
    rows = torch.cat([split.train, split.validation, *split.tests.values()])
    assert sorted(rows.tolist()) == [row for row in range(30) if row % 3]
    task = grasp_task(frames)
    right = torch.nn.functional.one_hot(torch.from_numpy(task.truth(rows)), 2).float()
    assert task.error(40 * right, rows) == pytest.approx(0, abs=1e-6)


def test_a_cloths_yarns_are_as_many_as_it_says(tmp_path: Path) -> None:
    """The strongest wave of corduroy's ten ridges lies along x, within the pieces' spread."""
    cloth = next(c for c in CLOTHS if c.name == "corduroy")
    y, x = np.mgrid[:256, :256].astype(np.float32) / 256
    height = cloth.pattern(10 * x, 10 * y)
    spectrum = np.abs(np.fft.rfft2(height - height.mean()))
    assert np.unravel_index(spectrum.argmax(), spectrum.shape) == (0, 10)
    over, under = (CLOTHS[0].pattern(np.full((256, 256), u, np.float32), 0 * x) for u in (0.5, 1.5))
    # plain weave: between two wefts a warp is up on every other yarn
    assert sorted([float(over[0, 0]), float(under[0, 0])]) == pytest.approx([0.5, 1.0])
    episodes = record_bench("cloths", tmp_path, RIG, 21, workers=1)
    clip = press_cloth(RIG, 20)
    assert clip.cloth == 0 and episodes.meta(20)["object"] == "poplin"
    change = np.abs(clip.frames.astype(int) - clip.frames[0]).mean((1, 2, 3))
    assert change[-1] > change[1] > change[0] == 0
    frames = read_cloths(episodes, 21, preprocessor_for(RIG.sensor))
    task = textile_task(frames)
    assert task.truth(torch.tensor([0, FRAMES, 20 * FRAMES])).tolist() == [0, 1, 0]


def test_metrics_of_labels_and_fields_by_hand() -> None:
    truth, predicted = np.array([0, 0, 0, 1]), np.array([[0, 0, 1, 1], [0, 0, 0, 0]])
    metrics = label_metrics(predicted, truth, np.arange(4))
    assert metrics["accuracy"] == pytest.approx(6 / 8)
    assert metrics["balanced_accuracy"] == pytest.approx((5 / 6 + 1 / 2) / 2)
    field = np.zeros((2, 3, 24, 24))
    field[0, :, 3, 4] = 3.0, 4.0, 10.0
    field[1, :, 5, 5] = 0.0, 5.0, 20.0
    half = 0.5 * field
    metrics = field_metrics(half[None], field, np.arange(2))
    assert metrics["shear_explained"] == pytest.approx(0.75)
    assert metrics["shear_rmse_kpa"] == pytest.approx(2.5)
    assert metrics["pressure_rmse_kpa"] == pytest.approx(np.sqrt((25 + 100) / 2))
    # what is said where nothing presses does not count, and nothing at all explains nothing
    half[:, :, 20, 20] = 100.0
    assert field_metrics(half[None], field, np.arange(2))["shear_explained"] == pytest.approx(0.75)
    assert field_metrics(0 * half[None], field, np.arange(2))["pressure_explained"] == 0


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


def test_the_benchmark_takes_published_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_probes(tmp_path / "files", strokes=5)
    options = Config(
        tasks=("force", "slip"), encoders=("end-to-end:tiny",), shares=(1.0,), data=tmp_path / "files",
        strokes=15, seeds=1, end_to_end_steps=2, end_to_end_batch_size=4, workers=1,
    )  # fmt: skip
    before = sorted((tmp_path / "files").rglob("*"))
    result = run(options)
    assert {row["task"] for row in result["rows"]} == {"force", "slip"}
    assert f"published files in {tmp_path / 'files'}: digit" in result["table"]
    assert sorted((tmp_path / "files").rglob("*")) == before  # nothing is written there
    with pytest.raises(UserError, match="is not for pose: choose --tasks force slip"):
        run(replace(options, tasks=("force", "pose")))

"""TacBench on the simulated rigs and on published files: mechanics, metrics by hand, toy runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from in_process import in_process_workers

from benchmarks.papers.tacbench.attentive import AttentivePooler
from benchmarks.papers.tacbench.benchmark import run
from benchmarks.papers.tacbench.config import Config
from benchmarks.papers.tacbench.data import STRIDE, RigFrames, read_strokes
from benchmarks.papers.tacbench.force import field_metrics, force_metrics
from benchmarks.papers.tacbench.labels import label_metrics
from benchmarks.papers.tacbench.slip import f1_score, slip_metrics
from benchmarks.papers.tacbench.task import split_force, split_slip
from benchmarks.papers.tacbench_rig.config import RigConfig, rig_unit
from benchmarks.papers.tacbench_rig.recording import record_bench
from benchmarks.papers.tacbench_rig.strokes import simulate
from touchgoal.control.features import TACTILE_LEFT, TRUTH_PAD_WRENCH, TRUTH_SLIP
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.pretrained import save
from touchgoal.encoders.ssl.frames import sample_frames
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.object_slides import REST, stick_slip_force

RIG = RigConfig(seed=3)
STROKES = 15


@pytest.fixture(scope="session")
def strokes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five strokes of each probe, the last two of them after an interruption."""
    folder = tmp_path_factory.mktemp("rig") / "strokes"
    with in_process_workers():
        record_bench("strokes", folder, RIG, STROKES - 2, workers=1)
        record_bench("strokes", folder, RIG, STROKES, workers=1)
    return folder


def test_shear_grows_with_the_slide_until_friction_gives_way() -> None:
    moved, load = np.array([0.0, 1e-4, 3e-4, 4e-4, 5e-4]), np.array([0.0, 2.0, 2.0, 2.0, 4.0])
    force, slides = stick_slip_force(moved[:, None], stiffness=6000.0, limits=0.5 * load)
    # k x = 0.6 N, then the cone at 0.5 * 2 N twice; with twice the load 1 + 6000 * 1e-4 N hold again
    assert force[:, 0] == pytest.approx([0.0, 0.6, 1.0, 1.0, 1.6])
    assert slides.tolist() == [False, False, True, True, False]
    places = np.array([[0.0, 0.0], [1e-4, 0.0], [3e-4, 0.0], [2e-4, 0.0], [2e-4, 4e-4]])
    force, slip = stick_slip_force(places, stiffness=1e4, limits=2.0)
    # 1 N; 3 N is too much; back by 0.1 mm: 1 N less; across: (1, 4) N cut to 2 N
    assert force[:4, 0] == pytest.approx([0, 1, 2, 1]) and slip.tolist() == [0, 0, 1, 0, 1]
    assert np.linalg.norm(force[4]) == pytest.approx(2)
    assert force[4, 1] / force[4, 0] == pytest.approx(4)


def test_a_stroke_is_untouched_pressed_and_drawn_the_same_each_time() -> None:
    stroke, again = simulate(RIG, 4), simulate(RIG, 4)
    assert np.array_equal(stroke.frames, again.frames) and stroke.indenter == "sharp"
    normal, shear = -stroke.wrench[:, 2], np.linalg.norm(stroke.wrench[:, :2], axis=1)
    assert (normal[:REST] == 0).all() and (normal[REST:] > 0).all()
    assert (shear <= stroke.friction * normal + 1e-6).all()
    on_cone = np.isclose(shear, stroke.friction * normal, rtol=1e-5) & (normal > 0)
    assert np.array_equal(on_cone, stroke.slip)
    change = np.abs(stroke.frames[-1].astype(int) - stroke.frames[0]).max()
    assert change > 30


def test_strokes_go_on_where_they_stopped_and_pairs_lie_a_stride_apart(strokes: Path) -> None:
    found = EpisodeSet(strokes)
    frames = read_strokes(found, STROKES, preprocessor_for("gelsight_mini_markers"))
    gap = np.arange(len(frames.before)) - frames.before.numpy()
    assert (gap[frames.pressed] == STRIDE).all()
    assert (frames.stroke[frames.before.numpy()] == frames.stroke).all()
    touches = sample_frames(found, RIG.sensor, 4, 0, (0, 5))  # one fingertip is enough
    assert len(touches) == 4 * len(found) and touches.touch.shape[1] == 2
    assert touches.wrench is not None and touches.wrench[:, 2].min() < 0
    assert [found.meta(i)["object"] for i in (0, 1, 2, 3)] == ["sphere", "sharp", "flat", "sphere"]
    whole = simulate(RIG, STROKES - 1)
    read = found.read(STROKES - 1).frames
    assert np.array_equal(read[TACTILE_LEFT], whole.frames)
    assert np.array_equal(read[TRUTH_PAD_WRENCH][:, :6], whole.wrench)
    assert np.array_equal(read[TRUTH_SLIP][:, 0], whole.slip)
    with pytest.raises(UserError, match="of another rig"):
        record_bench("strokes", strokes, RigConfig(seed=4), STROKES, workers=1)


def test_the_pooler_is_as_large_as_the_published_one() -> None:
    published = AttentivePooler(features=768, width=768, heads=12)
    assert sum(p.numel() for p in published.parameters()) == 7_088_640


def blank_frames(stroke: np.ndarray, indenter: np.ndarray) -> RigFrames:
    n = len(stroke)
    return RigFrames(
        touch=torch.zeros(n, 3, 1, 1).half(),
        before=torch.arange(n),
        force=torch.ones(n, 3),
        slip=torch.zeros(n, dtype=torch.bool),
        stroke=stroke,
        indenter=indenter,
    )


def test_metrics_are_what_they_are_called() -> None:
    errors = np.array([[[3e-3, 4e-3, 0.0], [-3e-3, 4e-3, 6e-3]]])
    metrics = force_metrics(errors, np.array([0, 1]))
    assert metrics["rmse_mn_by_axis"] == pytest.approx([3, 4, np.sqrt(18)])
    assert metrics["mae_mn"] == pytest.approx(20 / 6)
    assert metrics["rmse_mn"] == pytest.approx(np.sqrt((9 + 16 + 9 + 16 + 36) / 6))
    truth, predicted = np.array([1, 1, 0, 0, 1], bool), np.array([1, 0, 1, 0, 1], bool)
    assert f1_score(predicted, truth) == pytest.approx(2 / 3)
    both = slip_metrics(np.stack([predicted, truth]), truth, np.arange(5))
    assert both["f1"] == pytest.approx(5 / 6)


def test_test_strokes_are_not_learned_from() -> None:
    stroke = np.repeat(np.arange(30), 4)
    frames = blank_frames(stroke, np.array(["sphere", "sharp", "flat"])[stroke % 3])
    for split in (split_force(frames), split_slip(frames)):
        uses = [split.train, split.validation, *split.tests.values()]
        sets = [set(stroke[rows.numpy()]) for rows in uses]
        assert sum(len(s) for s in sets) == len(set().union(*sets))
        assert "flat" not in frames.indenter[torch.cat(uses[:2]).numpy()]
        assert len(split.train) == 3 * len(split.validation)


def test_encoders_are_judged(strokes: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    config = TouchBackboneConfig.for_sensor(PRESETS["tiny"], "gelsight_mini_markers")
    save(TouchBackbone(config), tmp_path / "tiny", {})
    name = str(tmp_path / "tiny")
    options = Config(
        encoders=(name, "end-to-end:tiny"), shares=(1.0, 0.1), rig=RIG, strokes=STROKES, slides=10,
        grasps=10, cloths=10, data=strokes.parent, seeds=1, steps=3, end_to_end_steps=2, workers=1,
    )  # fmt: skip
    with in_process_workers():
        result = run(options)
    force = [row for row in result["rows"] if row["task"] == "force"]
    tests = {"force": 2, "field": 2, "slip": 1, "pose": 1, "grasp": 2, "textile": 1}
    references = {"field": 2, "slip": 2}
    for task, count in tests.items():
        own = [row for row in result["rows"] if row["task"] == task]
        assert len(own) == count * (2 * 2 + references.get(task, 1))
    for row in force:
        low, high = row["rmse_mn_interval"]
        assert low <= row["rmse_mn"] <= high and row["mae_mn"] <= row["rmse_mn"]
    cone = next(row for row in result["rows"] if "nominal cone" in row["encoder"])
    assert cone["f1"] > 0.5
    assert "paper, real gelsight_mini" in result["table"] and "Sparsh (MAE)" in result["table"]
    assert "epoch" not in capsys.readouterr().out
    assert "epoch 3/3" in (strokes.parent / "training.log").read_text()
    shared_out = run(replace(options, tasks=("slip",), workers=2))["rows"]
    for row in [*result["rows"], *shared_out]:
        row.pop("seconds", None)
    assert shared_out == [row for row in result["rows"] if row["task"] == "slip"]


def test_the_field_over_the_image_adds_up_to_the_force() -> None:
    stroke, unit = simulate(RIG, 1), rig_unit(RIG)
    rows, columns = find_sensor(RIG.sensor).image_shape
    cell = rows * columns * unit.pixel_pitch**2 / 24**2
    force = 1e3 * cell * stroke.field.sum((2, 3))
    assert not stroke.field[:REST].any()
    np.testing.assert_allclose(force, stroke.wrench[:, :3] * [1, 1, -1], atol=0.02, rtol=0.01)


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

"""A fingertip that dies, from the start or in the run, is named before anything is pressed."""

import io
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from fake_cell import FakeCamera, FakeCell, FakeClock, KeptTicks, write_cell_file
from PIL import Image

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.deployment.actors import make_actor
from touchgoal.control.deployment.control_loop import Ending
from touchgoal.control.deployment.preflight import preflight
from touchgoal.control.deployment.session import Session
from touchgoal.control.interfaces import Frame, TactileSensor
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.fingertip_health import FingertipHealth
from touchgoal.control.safety.limits import FR3
from touchgoal.control.sensors.exchanged import probe_fingertips
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.launch.deploy import load_policy
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.in_process import simulate_cell

NAMED = {"black": "is black", "frozen": "stands still", "noise": "is noise", "white": "overexposed"}
TIPS = 'gripper = { kind = "franka_hand" }\ncameras.front = { source = "simulated" }\nfingertips = '


def live(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy = image + rng.normal(0, 1.5, image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def compressed(image: np.ndarray, quality: int) -> np.ndarray:
    Image.fromarray(image).save(data := io.BytesIO(), "JPEG", quality=quality)
    return np.array(Image.open(data))


@dataclass
class DyingTip:
    """A fingertip whose image has a fault from a time (s) on."""

    tip: TactileSensor
    fault: str
    since: float
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    kept: np.ndarray | None = None
    problem: str = ""

    def __post_init__(self) -> None:
        self.model = self.tip.model

    def read(self) -> Frame:
        frame = self.tip.read()
        if frame.stamp < self.since or self.kept is None:
            self.kept = frame.image
        if frame.stamp < self.since:
            return frame
        shown = {
            "black": lambda: live(np.zeros_like(frame.image), self.rng),
            "white": lambda: np.full_like(frame.image, 255),
            "frozen": lambda: self.kept,
            "noise": lambda: live(frame.image + self.rng.normal(0, 9, frame.image.shape), self.rng),
            "quality 30": lambda: compressed(frame.image, 30),
            "": lambda: frame.image,
        }
        return replace(frame, image=shown[self.fault]())

    def close(self) -> None:
        self.tip.close()


class LiveTip(FakeCamera):
    """An untouched fingertip with a sensor's noise; a new frame every 40 ms."""

    model, pressed = GELSIGHT_MINI, False

    def read(self) -> Frame:
        number = round(self.clock.time / 0.04)
        shown = load(self.model.sensor_file).background.copy()
        shown[100:140, 140:180] += np.uint8(60 * self.pressed)
        return Frame(live(shown, np.random.default_rng(number)), number, self.clock.time)


def fake_cell(fault: str, since: float) -> FakeCell:
    cell = FakeCell()
    tips = (LiveTip(cell.clock, np.zeros(0)) for _ in ft.TACTILE)
    cell.cameras = dict(zip(ft.TACTILE, tips, strict=True))
    cell.cameras[ft.TACTILE_LEFT] = DyingTip(cell.cameras[ft.TACTILE_LEFT], fault, since)
    return cell


@pytest.mark.parametrize("since", [0.0, 1.0])
@pytest.mark.parametrize("fault", NAMED)
def test_a_dead_fingertip_ends_the_run_or_keeps_it_from_beginning(fault: str, since: float) -> None:
    cell = fake_cell(fault, since)
    if not since and fault != "frozen":  # which one image does not show
        with pytest.raises(UserError, match=f"tactile_left: its image.* {NAMED[fault]}"):
            cell.run(lambda _: None)
        return
    ending = cell.run(lambda _: None)
    assert ending.stopped and ending.reason.startswith("tactile_left: its image")
    assert NAMED[fault] in ending.reason and len(cell.rows) <= 20 * since + 9


def test_a_sound_fingertip_and_a_single_bad_frame_end_nothing() -> None:
    assert not fake_cell("", 0).run(lambda _: None, seconds=3).stopped
    health, rng = FingertipHealth(GELSIGHT_MINI), np.random.default_rng(0)
    background = load(GELSIGHT_MINI.sensor_file).background
    frames = [live(background, rng) for _ in range(30)]
    frames[10], frames[20] = np.zeros_like(background), np.full_like(background, 255)
    assert not any(health.update(frame) for frame in frames)
    assert health.update(np.zeros_like(background)) == ""


@pytest.mark.parametrize("fault", [*NAMED, "quality 30", ""])
def test_the_preflight_names_a_dead_fingertip(fault: str, tmp_path: Path) -> None:
    cell = fake_cell(fault, 0.0)
    text = f'arm = "sim"\n{TIPS}{{ sensor = "gelsight_mini", left = "a", right = "b" }}\n'
    text += 'task = { name = "pick-place", policy = "expert", objects = ["wooden_block"] }\n'
    config = read_cell_file(write_cell_file(tmp_path, text))
    safety = ActionFilter(FR3, ft.CONTROL_HZ)
    lines = preflight(config, cell.connection(), safety, tmp_path, lambda: 0)
    left, right = (next(x for x in lines if x.name == k.split(".")[-1]) for k in ft.TACTILE)
    assert right.ok and left.ok == (not fault)
    assert (NAMED | {"quality 30": "compressed", "": ""})[fault] in left.remedy


@pytest.mark.parametrize(
    ("felt_by", "message"),
    [
        ("lr", ""),
        ("rl", "the right fingertip felt the touch of the left"),
        ("l-", "right .* no touch"),
    ],
)
def test_each_fingertip_answers_on_its_own_side(felt_by: str, message: str) -> None:
    tips = {name: LiveTip(FakeClock(), np.zeros(0)) for name in ("left", "right")}
    asked: list[str] = []

    def wait(seconds: float) -> None:
        """Press 2 s after each question, for half a second, what `felt_by` names for it."""
        for name, tip in tips.items():
            tip.clock.time += seconds
            since = tip.clock.time - (len(asked) - 1) * 2.5
            tip.pressed = 2 <= since < 2.5 and felt_by[len(asked) - 1] == name[0]

    with pytest.raises(UserError, match=message) if message else nullcontext():
        probe_fingertips(tips, asked.append, wait)
    assert [line.split()[2] for line in asked] == ["left", "right"][: 1 if felt_by == "rl" else 2]


def run_simulated(task: str, fault: str, since: float, folder: Path) -> tuple[Ending, float]:
    """How a run of a simulated cell ends, and the largest force on the hand (N)."""
    sensor = "gelsight_mini_markers" if "bead" in task else "gelsight_mini"
    tips = f'{{ sensor = "{sensor}", left = "simulated", right = "simulated" }}'
    cell = read_cell_file(write_cell_file(folder, f'arm = "sim"\n{TIPS}{tips}\n{task}'))
    connection = simulate_cell(cell, ft.CONTROL_HZ)
    tip = connection.cameras[ft.TACTILE_RIGHT]
    assert isinstance(tip, TactileSensor)
    connection.cameras[ft.TACTILE_RIGHT] = DyingTip(tip, fault, since)
    policy, size = load_policy(cell)
    safety = ActionFilter(connection.robot, ft.CONTROL_HZ)
    result = Session(
        cell,
        connection,
        safety,
        KeptTicks(),
        execute=True,
        make_actor=lambda loop: make_actor(cell, policy, safety, connection.truth, loop.commanded),
        operator_request=lambda: "",
        on_tick=lambda _: None,
        camera_size=size,
    ).run()
    return result.ending, result.log.max_force


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["black", "frozen", "noise"])
@pytest.mark.parametrize(("task", "since"), [("pick-place", 4.0), ("bead-maze", 4.0)])
def test_a_fingertip_that_dies_in_a_task_is_named_before_it_crushes(
    task: str, since: float, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("touchgoal.sim_envs.cell.in_process.time.sleep", lambda _: None)
    options = 'policy = "expert", objects = ["wooden_block"]'
    if task == "bead-maze":
        options = 'policy = "shipped", wires = ["helix-3"]'
    text = f'task = {{ name = "{task}", seed = 3, {options} }}\n'
    ending, force = run_simulated(text, fault, since, tmp_path)
    assert ending.stopped and ending.reason.startswith("tactile_right: its image")
    assert NAMED[fault] in ending.reason and force < 15

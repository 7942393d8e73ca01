"""Exchanged cameras and fingertips are noticed at the start, and right ones are not."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest
from fake_cell import SIM, FakeArm, FakeCamera, FakeCell, KeptTicks, write_cell_file

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.deployment.control_loop import ControlLoop
from touchgoal.control.deployment.preflight import preflight
from touchgoal.control.deployment.scripted import ScriptedActor
from touchgoal.control.deployment.session import Session
from touchgoal.control.interfaces import Frame
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.control.sensors.exchanged import cameras_exchanged, fingertips_exchanged
from touchgoal.control.sensors.tactile_camera import NO_CROP, TactileCamera
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI, find_sensor
from touchgoal.runtime.errors import CheckResult
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

STARTS = 10


def drifted(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Change the light as between days: gain, offset and a smooth pattern (spreads of `background.py`)."""
    height = image.shape[0]
    wave = np.cos(np.pi * rng.integers(1, 4) * np.arange(height) / height)[:, None, None]
    changed = image * (1 + 0.047 * rng.normal(size=3)) + 2.4 * rng.normal(size=3)
    return np.clip(changed + 2.4 * rng.normal() * wave, 0, 255).astype(np.uint8)


def test_exchanged_fingertips_are_noticed_at_every_start() -> None:
    for seed in range(STARTS):
        rng = np.random.default_rng(seed)
        units = [sample_instance(GELSIGHT_MINI, rng) for _ in range(2)]
        left, right = (render_untouched(unit, rng) for unit in units)
        frames = [drifted(render_untouched(unit, rng), rng) for unit in units]
        assert not fingertips_exchanged((frames[0], frames[1]), (left, right))
        assert fingertips_exchanged((frames[1], frames[0]), (left, right))
        assert not fingertips_exchanged((frames[0], frames[1]), (left, left)), "one file for both"


class LiveCamera(FakeCamera):
    """A camera with a sensor's noise, without which its image would stand still."""

    def read(self) -> Frame:
        frame = super().read()
        noise = np.random.default_rng(frame.sequence).integers(-1, 2, frame.image.shape)
        noisy = np.clip(frame.image.astype(int) + noise, 0, 255).astype(np.uint8)
        return Frame(noisy, frame.sequence, frame.stamp)


def preflighted(
    images: list[np.ndarray], untouched: list[np.ndarray], folder: Path
) -> dict[str, CheckResult]:
    """The pre-flight's lines on two fingertips that show these, each with a sensor file of its own."""
    cell, files = FakeCell(), []
    for key, image, background in zip(ft.TACTILE, images, untouched, strict=True):
        files.append(str(folder / key))
        shutil.copytree(GELSIGHT_MINI.sensor_file, files[-1])
        cv2.imwrite(f"{files[-1]}/background.png", background[..., ::-1])
        camera = LiveCamera(cell.clock, image)
        cell.cameras[key] = TactileCamera(camera, find_sensor(files[-1]), NO_CROP)
    tips = 'fingertips = { sensor = "gelsight_mini", left = "http://l", right = "http://r", '
    file = write_cell_file(folder, f"{tips}sensor_files = {files} }}\n{SIM}")
    safety = ActionFilter(FR3, ft.CONTROL_HZ)
    lines = preflight(read_cell_file(file), cell.connection(), safety, folder, lambda: 0)
    return {line.name: line for line in lines}


def test_the_preflight_names_exchanged_and_touched_fingertips(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    units = [sample_instance(GELSIGHT_MINI, rng) for _ in range(2)]
    files = [render_untouched(unit, rng) for unit in units]
    now = [render_untouched(unit, rng) for unit in units]
    lines = preflighted(now, files, tmp_path / "right")
    assert lines["fingertips"].ok and lines["tactile_left"].ok
    assert "each looks like its own" in lines["fingertips"].detail
    line = preflighted(now, files[:1] * 2, tmp_path / "one file")["fingertips"]
    assert line.ok and "not checked" in line.detail
    lines = preflighted(now[::-1], files, tmp_path / "wrong")
    assert not lines["fingertips"].ok and "exchange fingertips.left" in lines["fingertips"].remedy
    now[0][100:140, 140:180] += 60
    lines = preflighted(now, files, tmp_path / "touched")
    assert not lines["tactile_left"].ok and "touched" in lines["tactile_left"].remedy
    assert lines["tactile_right"].ok


def test_exchanged_cameras_are_noticed_where_there_is_something_to_see() -> None:
    """Images before and after a move of the arm."""
    rng, noticed = np.random.default_rng(0), 0
    views = "front", "wrist"
    env = PickPlace(PickPlaceConfig(cameras=views, camera_size=(256, 256), tactile=False))

    def taken() -> list[np.ndarray]:
        images = [env.render_camera(name) * rng.uniform(0.9, 1.1) for name in views]
        noisy = [p + rng.normal(0, 3, p.shape) for p in images]
        return [np.clip(p, 0, 255).astype(np.uint8) for p in noisy]

    for seed in range(STARTS):
        env.reset(seed=seed)
        before, way = taken(), rng.normal(size=7)
        env.data.qpos[env.arm_positions] += way * rng.uniform(0.1, 0.4) / np.abs(way).max()
        mujoco.mj_forward(env.model, env.data)
        front, wrist = zip(before, taken(), strict=True)
        assert not cameras_exchanged(front, wrist)
        noticed += cameras_exchanged(wrist, front)
    env.close()
    assert noticed >= 7  # of 10: a bare table tells nothing


@dataclass
class CameraOnTheArm(FakeCamera):
    """Shows an image that moves as the first joint does."""

    arm: FakeArm | None = None

    def read(self) -> Frame:
        assert self.arm is not None
        moved = np.roll(self.image, round(100 * self.arm.reading.q[0]), 1)
        return Frame(moved, round(1000 * self.clock.time), self.clock.time)


@pytest.mark.parametrize("exchanged", [False, True])
def test_exchanged_cameras_end_a_run_after_its_start_move(exchanged: bool, tmp_path: Path) -> None:
    start = FR3.arm.home + np.array([0.3, *[0.0] * 6])
    text = SIM.replace("seed = 3", f"start = {start.tolist()}")
    cell, scene = FakeCell(), np.random.default_rng(0).integers(0, 255, (128, 128, 3), np.uint8)
    fixed = FakeCamera(cell.clock, scene)
    carried = CameraOnTheArm(cell.clock, scene, arm=cell.arm)
    views = (carried, fixed) if exchanged else (fixed, carried)
    cell.cameras = dict(zip(ft.CAMERAS, views, strict=True))

    def actor(loop: ControlLoop) -> ScriptedActor:
        return ScriptedActor([], loop.commanded, ft.CONTROL_HZ)

    config, safety = read_cell_file(write_cell_file(tmp_path, text)), ActionFilter(FR3, 20)
    no_operator = {"operator_request": lambda: "", "on_tick": lambda _: None}
    session = Session(config, cell.connection(), safety, KeptTicks(), True, actor, **no_operator)
    ending = session.run().ending
    assert ending.stopped == exchanged and ("look exchanged" in ending.reason) == exchanged

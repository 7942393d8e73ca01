"""Deploying: on the twin through libfranka over the wire, on a simulated arm, and with faults."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from running_twin import RunningTwin

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig, read_cell_file
from touchgoal.control.cell.connection import cell_watchdogs
from touchgoal.control.errors import UserError
from touchgoal.control.safety.action_filter import Safety
from touchgoal.episodes.repair import validate
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch import deploy
from touchgoal.launch.__main__ import main
from touchgoal.policies.deploy.control_loop import ControlLoop, RunLog, TickStatus
from touchgoal.sim_envs.twin.in_process import simulate_cell

_PATIENCE = 300  # s for a loop, on a machine however loaded
CELL_FILES = Path(deploy.__file__).parent / "cells"  # of the wheel, where that is tested
SIM = """
arm = "sim"
gripper = { kind = "franka_hand" }
cameras.front = { source = "simulated" }
task = { name = "pick-place", policy = "expert", object = "wooden_block", seed = 3 }
"""


def run(*arguments: object) -> None:
    main([str(a) for a in arguments])


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningTwin]:
    pytest.importorskip("franky", reason="pip install 'touchgoal[franka]'")
    cell = ["--lock-step", "--object", "wooden_block", "--seed", "3", "--env.cameras", "front"]
    twin = RunningTwin(cell, tmp_path_factory.mktemp("twin"), 2)
    yield twin
    twin.close()


def deploying(twin: RunningTwin, out: Path) -> "subprocess.Popen[str]":
    """`touchgoal deploy --execute` as a person runs it: in here its types would be checked meanwhile."""
    cell_file = out / "cell.json"
    cell_file.write_text(json.dumps(twin.description))
    command = [
        sys.executable,
        "-m",
        "touchgoal.launch",
        "deploy",
        str(cell_file),
        "--execute",
        "--yes",
    ]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*command, "--out", str(out / "run")], **pipes)


def touch_comes_nearer(out: Path) -> bool:
    """Whether `touchgoal reward-curves` says so of the deployed episode."""
    curves = ["reward-curves", str(out / "run" / "episodes"), "--out", str(out / "curves")]
    subprocess.run([sys.executable, "-m", "touchgoal.launch", *curves], check=True)
    report = json.loads((out / "curves" / "episode_000.json").read_text())
    return report["metrics"]["tactile"]["end"] < report["metrics"]["tactile"]["start"]


def write_cell_file(folder: Path, text: str) -> Path:
    path = folder / "cell.toml"
    path.write_text(text)
    return path


@pytest.mark.realtime
def test_picks_and_places_on_the_twin_and_the_episode_has_reward_curves(
    twin: RunningTwin, tmp_path: Path
) -> None:
    process = deploying(twin, tmp_path)
    _, complaint = process.communicate(timeout=_PATIENCE)
    assert process.returncode == 0, complaint
    said = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert said["success"] and not said["stopped"] and said["episode"] == 0
    worst = twin.ask("truth")["worst"]
    assert worst["excess"] == 0 and worst["speed"] < 1
    assert touch_comes_nearer(tmp_path)


@pytest.mark.realtime
def test_the_shipped_policy_leads_a_bead_on_the_twin(tmp_path: Path) -> None:
    pytest.importorskip("franky", reason="pip install 'touchgoal[franka]'")
    cell = ["--lock-step", "--task", "bead-maze", "--wire", "helix-3"]
    small = ["--maze.cameras", "front", "--maze.camera-size", "128", "128"]
    twin = RunningTwin([*cell, *small], tmp_path, 3)
    _, complaint = deploying(twin, tmp_path).communicate(timeout=_PATIENCE)
    worst = twin.ask("truth")["worst"]
    twin.close()
    assert complaint == "" and worst["excess"] == 0 and worst["speed"] < 1
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["success"]
    assert touch_comes_nearer(tmp_path)


@pytest.mark.realtime
def test_a_stalled_camera_stops_the_arm_and_the_episode_is_kept(
    twin: RunningTwin, tmp_path: Path
) -> None:
    twin.begin("reset 3")
    process = deploying(twin, tmp_path)
    while np.abs(twin.ask("truth")["dq"]).max() < 0.1:
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)
    twin.ask("stall front 60")
    _, complaint = process.communicate(timeout=_PATIENCE)
    twin.ask("stall front 0")
    assert process.returncode == 1 and "observation age" in complaint and "front" in complaint
    said = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert said["stopped"] and said["rest_seconds"] < 3 and "cable" in said["advice"]
    episodes = tmp_path / "run" / "episodes"
    assert EpisodeSet(episodes).meta(0)["outcome"] == "stopped" and validate(episodes) == []


def test_a_simulated_arm_reaches_the_same_outcome(tmp_path: Path) -> None:
    run("deploy", write_cell_file(tmp_path, SIM), "--execute", "--yes", "--out", tmp_path / "run")
    said = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert said["success"] and EpisodeSet(tmp_path / "run" / "episodes").meta(0)["arm"] == "sim"


def test_a_dry_run_moves_and_records_nothing(tmp_path: Path) -> None:
    text = SIM.replace("seed = 3", "seed = 3, seconds = 1.0")
    run("deploy", write_cell_file(tmp_path, text), "--out", tmp_path / "run")
    said = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert said["ticks"] > 10 and said["episode"] is None and not said["success"]


class Acts:
    """Moves the base at 0.2 rad/s, and after `after` ticks does `then`."""

    done, action_age = False, 0.0

    def __init__(self, after: int, then: float) -> None:
        self._left, self._then = after, then

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self._left -= 1
        return np.array([0.01 if self._left > 0 else self._then, *np.zeros(6), 0.08])

    def close(self) -> None: ...


def deployed(cell: CellConfig, actor: Acts, stop_after: int = 10_000) -> tuple[str, bool, float]:
    """How it ends, whether it was stopped, and the farthest that the first joint got (rad)."""
    connection, count = simulate_cell(cell, ft.CONTROL_HZ), 0

    def wanted() -> str:
        nonlocal count
        count += 1
        return "stop" if count > stop_after else ""

    far = [0.0]

    def show(status: TickStatus) -> None:
        far[0] = max(far[0], float(status.sensed.arm.q[0]))

    safety = Safety(connection.robot, ft.CONTROL_HZ, cell_watchdogs(cell))
    loop = ControlLoop(connection, safety, True, wanted, show)
    ending = loop.run(actor, 20.0, RunLog())
    assert np.abs(connection.arm.read().velocity).max() < 0.01
    return ending.reason, ending.stopped, far[0]


@pytest.fixture
def bare(tmp_path: Path) -> CellConfig:
    text = SIM.replace('cameras.front = { source = "simulated" }\n', "")
    return read_cell_file(write_cell_file(tmp_path, text))


def test_a_policy_that_is_not_a_number_and_an_operator_stop_the_arm(bare: CellConfig) -> None:
    reason, stopped, _ = deployed(bare, Acts(10, np.nan))
    assert stopped and "not a number" in reason
    reason, stopped, _ = deployed(bare, Acts(10_000, 0.0), stop_after=15)
    assert stopped and reason == "stopped by the operator"


@pytest.mark.parametrize("path", sorted(CELL_FILES.glob("*.toml")), ids=lambda p: p.stem)
def test_example_cell_files_are_read(path: Path) -> None:
    assert read_cell_file(path).task.name == "pick-place"


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (SIM.replace('arm = "sim"', ""), "arm is missing"),
        (SIM.replace('"sim"', '"fr4"'), "arm is to be fr3 or ur5e or sim"),
        (SIM.replace('"sim"', '"fr3"'), "address is missing"),
        (SIM + "speed = 3", "speed is unknown"),
        (SIM.replace("cameras.front", "cameras.back"), "cameras.back is unknown"),
        (SIM.replace("seed = 3", 'seed = "3"'), "task.seed is to be a number"),
        (SIM + "safety = { force = true }", "safety.force is to be a number"),
        ("arm =", "is no TOML"),
    ],
)
def test_a_bad_cell_file_is_one_line(wrong: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=says):
        read_cell_file(write_cell_file(tmp_path, wrong))

"""Deploying by a simulator's own time: one seed and one file give the same run, however slow the machine."""

import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from in_process import run_benchmark
from running_twin import RunningTwin

from benchmarks.deployment.replay import replay_both
from touchgoal.control import features as ft
from touchgoal.control.arms.client_libraries import FRANKY
from touchgoal.control.cell.cell_file import EXAMPLES
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import connect_cell
from touchgoal.control.cell.twin_client import connect_control_port, reset_scene
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.__main__ import main
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError

_TICKS = 8
_SMALL = "--env.objects wooden_block --env.cameras front --env.camera-size 96 96".split()


def swing(
    cell: CellConfig, pause: float, pause_pictures: Callable[[float], None] | None = None
) -> list[np.ndarray]:
    """Return all readings of each tick while the arm swings and the hand closes."""
    reset_scene(cell.task.twin, cell.task.seed)
    connection, seen = connect_cell(cell, ft.CONTROL_HZ), []
    q = connection.arm.read().q
    for k in range(_TICKS):
        connection.arm.command(q + 0.1 * np.sin(k / 6))
        connection.gripper.command(0.0)
        connection.clock.wait(connection.clock.now() + 1 / ft.CONTROL_HZ)
        time.sleep(pause * (k % 2))  # a machine that is busy now and then
        if pause_pictures and k == 4:
            pause_pictures(2.0)  # twice as long as libfranka waits for a state
        arm, width = connection.arm.read(), connection.gripper.read().width
        assert connection.load_cell is not None
        load = connection.load_cell.read().force
        seen.append(np.concatenate([arm.q, arm.velocity, arm.torque, [load, arm.time, width]]))
        seen += [camera.read().image for camera in connection.cameras.values()]
    connection.close()
    return seen


@pytest.mark.slow
def test_a_lock_step_twin_gives_the_same_run_to_the_last_bit(tmp_path: Path) -> None:
    """The twin's time advances only while the deployment waits."""
    pytest.importorskip("franky", reason=FRANKY.install)
    with closing(RunningTwin(["--lock-step", *_SMALL, "--seed", "3"], tmp_path, 4)) as twin:
        first = swing(twin.cell, 0.0)
        states = [seen for seen in first if seen.ndim == 1]
        assert states[-1][0] - states[0][0] > 0.05 and states[-1][-1] < 0.07
        assert states[-1][-2] == pytest.approx(_TICKS / ft.CONTROL_HZ)
        again = swing(twin.cell, 0.1, twin.pause_pictures)
        assert len(first) == len(again)
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
        left_at = twin.ask("truth")["time"]
        time.sleep(0.1)
        assert twin.ask("truth")["time"] > left_at


@pytest.mark.slow
def test_the_same_actions_lead_to_the_same_place_in_the_environment_and_over_the_wire() -> None:
    pytest.importorskip("franky", reason=FRANKY.install)
    wave, press = replay_both(seed=seeds.REPLAY.start)
    for row in (wave, press):
        assert row["joints"] < 0.01 and row["tool"] < 2e-3  # rad, m
    assert wave["force here"] == 0 and press["force here"] > 5
    assert press["force there"] == pytest.approx(press["force here"], rel=0.2)


@pytest.mark.parametrize("address", ["", "127.0.0.1:1"])
def test_a_lock_step_cell_without_a_twin_is_one_line(address: str) -> None:
    with pytest.raises(UserError, match="start one: touchgoal twin"):
        connect_control_port(address)


@pytest.mark.slow
def test_benchmark_deploy_counts_what_deploy_did(tmp_path: Path) -> None:
    """The maze's example file, without a twin; half a second does not reach the wire's end."""
    run = "deploy --tasks bead-maze --policies scripted --episodes 1".split()
    run_benchmark(*run, "--arms", "in-process", "--seconds", "0.5", "--out", str(tmp_path / "run"))
    done = json.loads((tmp_path / "run" / "metrics.json").read_text())["deployments"]
    assert len(done) == 1 and done[0]["policy"] == "follower" and not done[0]["success"]
    assert "time is up" in done[0]["ending"] and done[0]["progress"] < 0.2


@pytest.mark.slow
def test_a_simulated_arm_gives_the_same_recording_again(tmp_path: Path) -> None:
    """The shipped policy plans in a thread of its own: it is waited for."""
    text = (EXAMPLES / "sim.toml").read_text().replace("seconds = 40.0", "seconds = 0.8")
    (tmp_path / "cell.toml").write_text(text.replace("start = ", "# "))
    deploy = ["deploy", str(tmp_path / "cell.toml"), "--policy", "shipped", "--execute", "--yes"]
    for _ in range(2):
        with pytest.raises(SystemExit):  # time is up
            main([*deploy, "--out", str(tmp_path / "run")])
    episodes = EpisodeSet(tmp_path / "run" / "episodes")
    first, again = (episodes.read(i).frames for i in range(2))
    assert np.ptp(first[ft.STATE][:, :7], axis=0).max() > 0.01  # it has moved
    for key in first.keys() - {"timestamp"}:
        np.testing.assert_array_equal(first[key], again[key], err_msg=key)

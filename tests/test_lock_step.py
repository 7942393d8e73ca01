"""Deploying by a simulator's own time: one seed and one file give the same run, however slow the machine."""

import json
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from in_process import run_benchmark
from running_twin import RunningTwin

from touchgoal.control import features as ft
from touchgoal.control.arms.client_libraries import FRANKY
from touchgoal.control.cell.cell_file import EXAMPLES
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import connect_cell
from touchgoal.control.cell.twin_client import connect_control_port
from touchgoal.control.interfaces import ArmReading
from touchgoal.control.motion.tracker import ServoLag
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import Box, RobotLimits
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.deployed_arm import measurements_at_rest
from touchgoal.sim_envs.cell.deployment import DeploymentConfig
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace

_TICKS = 8
_SMALL = "--env.objects wooden_block --env.cameras front --env.camera-size 96 96".split()


def swing(
    cell: CellConfig, pause: float, pause_images: Callable[[float], None] | None = None
) -> list[np.ndarray]:
    """Return all readings of each tick while the arm swings and the hand closes."""
    connection, seen = connect_cell(cell), []
    q = connection.arm.read().q
    for k in range(_TICKS):
        connection.arm.command(q + 0.1 * np.sin(k / 6))
        connection.gripper.command(0.0)
        connection.clock.wait(connection.clock.now() + 1 / ft.CONTROL_HZ)
        time.sleep(pause * (k % 2))  # a machine that is busy now and then
        if pause_images and k == 4:
            pause_images(2.0)  # twice as long as libfranka waits for a state
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
        again = swing(twin.cell, 0.1, twin.pause_images)
        assert len(first) == len(again)
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
        left_at = twin.ask("truth")["time"]
        time.sleep(0.1)
        assert twin.ask("truth")["time"] > left_at


def press(env: PickPlace) -> list[np.ndarray]:
    """A slow descent onto the table, to 0.5 mm below its top; a faster one triggers the reflex."""
    q = env.command.copy()
    tool, (position, R) = env.robot.tool, env.kinematics.forward(q)
    corners = position + (np.array(tool.finger_corners) - [0, 0, tool.tcp_offset]) @ R.T
    drop, actions = corners[:, 2].min(), []
    low = np.linspace(drop - 0.005, drop + 5e-4, 50)
    for depth in [*np.linspace(0, drop - 0.005, 50), *low, *[low[-1]] * 10]:
        wanted = env.kinematics.solve_ik_near(position - [0, 0, depth], R, q).q
        actions.append(wanted - q)
        q = wanted
    return actions


def able_to_press(robot: RobotLimits) -> RobotLimits:
    box = robot.fingertips
    return replace(robot, fingertips=Box(np.array([*box.lower[:2], -0.02]), box.upper))


def over_the_wire(cell: CellConfig, actions: list[np.ndarray]) -> list[ArmReading]:
    connection = connect_cell(cell)
    robot, arm, seen = able_to_press(connection.robot), connection.arm, []
    safety, lag = ActionFilter(robot, ft.CONTROL_HZ), ServoLag(robot, 1 / ft.CONTROL_HZ)
    state = safety.start(arm.read().q)
    with closing(connection):
        for action in actions:
            step = lag.update(action.astype(np.float32).astype(np.float64))
            state = safety.filter_action(state, step, measurements_at_rest(state.q))
            arm.command(state.q)
            connection.gripper.command(0.0)
            connection.clock.wait(connection.clock.now() + 1 / ft.CONTROL_HZ)
            seen.append(arm.read())
    return seen


@pytest.mark.slow
def test_the_same_actions_lead_to_the_same_place_in_the_environment_and_over_the_wire(
    tmp_path: Path,
) -> None:
    pytest.importorskip("franky", reason=FRANKY.install)
    none, delay, seed = (0.0, 0.0), (0.005, 0.005), 1  # s from a command to the arm on the wire
    late = DeploymentConfig(command_delay=delay, state_delay=none, jitter=none)
    task = PickPlaceConfig(objects=("wooden_block",), cameras=(), as_deployed=True, deployment=late)
    env = PickPlace(task)
    env.robot = able_to_press(env.robot)
    options = f"--lock-step --no-wrench-error --env.objects wooden_block --seed {seed}".split()
    env.reset(seed=seed)
    actions, here, force = press(env), [], []
    for action in actions:
        env.step(np.append(action, 0.0).astype(np.float32))
        here.append(env.kinematics.forward(env.joints()[0])[0])
        force.append(np.linalg.norm(env.external_wrench()[:3]))
    with closing(RunningTwin(options, tmp_path, 5)) as twin:
        seen = over_the_wire(replace(twin.cell, cameras={}, fingertips=None), actions)
    there = [env.kinematics.forward(arm.q)[0] for arm in seen]
    assert np.linalg.norm(np.subtract(here, there), axis=1).max() < 2e-3  # m
    pressing = np.array(force) > 1.0  # N
    wired = np.array([np.linalg.norm(arm.wrench[:3]) for arm in seen])[pressing]
    assert np.median(wired) == pytest.approx(np.median(np.array(force)[pressing]), rel=0.2)
    assert np.median(wired) > 5


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

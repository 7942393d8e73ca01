"""The same actions in the environment as deployed and over the wire: distance between the two arms.

No policy acts: the joints wave in free air, and a closed hand presses onto the table.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.deployment.deployed_episode import Scene, deployed_twin
from benchmarks.options import BenchmarkOptions
from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import connect_cell
from touchgoal.control.motion.tracker import ServoLag
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import Box, RobotLimits
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.cell.deployed_arm import measurements_at_rest
from touchgoal.sim_envs.cell.deployment import DeploymentConfig
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark replay."""

    episodes: Count = 3
    """Number of seeds; each gives a wave and a press."""
    seed: Seed = seeds.REPLAY.start
    """First random seed."""


_OBJECT = "wooden_block"
_HZ = ft.CONTROL_HZ
_FLOOR = -0.02  # m, lower bound of the box here, so that the table can be pressed
_DELAY = 0.005  # s from a command to the arm: half of the two streams' periods
_WAVE_SECONDS, _WAVE = 2.0, 0.012  # s, and rad a tick at most
_ABOVE = 0.005  # m of the fingers' lowest corner above the table where it slows down
_PRESSED = -5e-4  # m, commanded height of that corner at the end
_DOWN, _PRESS, _HOLD = 2.5, 2.5, 0.5  # s; a faster press would trigger the reflex
_TOUCHING = 1.0  # N


@dataclass(frozen=True)
class Replayed:
    """Measurements of a sequence of actions, tick by tick."""

    q: Float[np.ndarray, "t 7"]  # joint positions, rad
    force: Float[np.ndarray, "t 3"]  # external, on the hand, N (base frame)


def run(config: Config) -> dict[str, Any]:
    """Replay both motions for every seed."""
    rows, lines = [], [f"{'motion, seed':<18}{'joints rad':>12}{'tool mm':>10}{'force N':>18}"]
    for k in range(config.episodes):
        for row in replay_both(config.seed + k, k):
            rows.append(row)
            forces = f"{row['force here']:.1f} and {row['force there']:.1f}"
            lines.append(
                f"{row['motion'] + ', ' + str(row['seed']):<18}{row['joints']:>12.4f}"
                f"{1e3 * row['tool']:>10.2f}{forces if row['motion'] == 'press' else '':>18}"
            )
    lines += [
        "joints and tool: greatest distance at a tick; force: median while the table is pressed,",
        "in the environment and over the wire",
    ]
    return {"rows": rows, "table": "\n".join(lines)}


def replay_both(seed: int, number: int = 0) -> Iterator[dict[str, Any]]:
    """Yield the distance of the arms in a wave and in a press, on a twin of their own.

    `joints` (rad) and `tool` (m): greatest distance at any tick. `force here`, `force there`: median
    force (N) while the table is pressed, in the environment and over the wire.
    """
    env = _environment()
    scene = Scene("pick-place", seed, _OBJECT)
    with (
        tempfile.TemporaryDirectory() as name,
        deployed_twin(scene, True, Path(name), number, exact=True) as cell_file,
    ):
        cell = replace(read_cell_file(cell_file), cameras={}, fingertips=None)
        for motion, actions_of in (("wave", _wave), ("press", _press)):
            env.reset(seed=seed)
            actions = list(actions_of(env, seed))
            here = _in_environment(env, actions, seed)
            there = _over_the_wire(cell, actions, seed)
            yield {"motion": motion, "seed": seed, **_distances(env, here, there)}


def _environment() -> PickPlace:
    none, delay = (0.0, 0.0), (_DELAY, _DELAY)
    deployment = DeploymentConfig(
        command_delay=delay, state_delay=none, jitter=none, estimated_wrench=False
    )
    # fingertips as the twin's, drawn by the same seed, so that arm and object begin alike
    env = PickPlace(
        PickPlaceConfig(objects=(_OBJECT,), cameras=(), as_deployed=True, deployment=deployment)
    )
    env.robot = _able_to_press(env.robot)
    return env


def _able_to_press(robot: RobotLimits) -> RobotLimits:
    box = robot.fingertips
    low = np.array([*box.lower[:2], _FLOOR])
    return replace(robot, fingertips=Box(low, box.upper))


def _wave(env: PickPlace, seed: int) -> Iterator[np.ndarray]:
    """Yield joint changes that swing, each joint at its own rate."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.3, 1.0, env.n_joints), rng.uniform(0, 2 * np.pi, env.n_joints)
    for t in np.arange(0, _WAVE_SECONDS, 1 / _HZ):
        swing = _WAVE * np.sin(2 * np.pi * rate * t + phase) * min(1.0, t)
        yield np.append(swing, 0.0)


def _press(env: PickPlace, _: int) -> Iterator[np.ndarray]:
    """Yield a slow descent onto the table with a closed hand."""
    q = env.command.copy()
    tool, (position, R) = env.robot.tool, env.kinematics.forward(q)
    corners = position + (np.array(tool.finger_corners) - [0, 0, tool.tcp_offset]) @ R.T
    drop = corners[:, 2].min()
    stages = [
        np.linspace(0, drop - _ABOVE, round(_DOWN * _HZ)),
        np.linspace(drop - _ABOVE, drop - _PRESSED, round(_PRESS * _HZ)),
        np.full(round(_HOLD * _HZ), drop - _PRESSED),
    ]
    for depth in np.concatenate(stages):
        wanted = env.kinematics.solve_ik_near(position - [0, 0, depth], R, q).q
        yield np.append(wanted - q, 0.0)
        q = wanted


def _in_environment(env: PickPlace, actions: list[np.ndarray], seed: int) -> Replayed:
    env.reset(seed=seed)
    q, force = [], []
    for action in actions:
        env.step(action.astype(np.float32))
        q.append(env.joints()[0].copy())
        force.append(env.external_wrench()[:3].copy())
    return Replayed(np.array(q), np.array(force))


def _over_the_wire(cell: CellConfig, actions: list[np.ndarray], seed: int) -> Replayed:
    connection = connect_cell(replace(cell, task=replace(cell.task, seed=seed)), _HZ)
    robot = _able_to_press(connection.robot)
    safety, lag = ActionFilter(robot, _HZ), ServoLag(robot, 1 / _HZ)
    arm, q, force = connection.arm, [], []
    state = safety.start(arm.read().q)
    try:
        for action in actions:
            step = lag.update(action[:-1].astype(np.float32).astype(np.float64))
            state = safety.filter_action(state, step, measurements_at_rest(state.q))
            arm.command(state.q)
            connection.gripper.command(float(action[-1]))
            connection.clock.wait(connection.clock.now() + 1 / _HZ)
            reading = arm.read()
            q.append(reading.q)
            force.append(reading.wrench[:3])
    finally:
        connection.close()
    return Replayed(np.array(q), np.array(force))


def _distances(env: PickPlace, here: Replayed, there: Replayed) -> dict[str, float]:
    tools = (np.array([env.kinematics.forward(q)[0] for q in r.q]) for r in (here, there))
    pressing = np.linalg.norm(here.force, axis=1) > _TOUCHING
    force_here, force_there = (
        float(np.median(np.linalg.norm(r.force[pressing], axis=1))) if pressing.any() else 0.0
        for r in (here, there)
    )
    return {
        "joints": float(np.abs(here.q - there.q).max()),
        "tool": float(np.linalg.norm(np.subtract(*tools), axis=1).max()),
        "force here": force_here,
        "force there": force_there,
    }

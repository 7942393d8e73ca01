"""How well the arms' own mathematics does: inverse kinematics, and how long moves take."""

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from touchgoal.benchmarks.config import MotionOptions
from touchgoal.benchmarks.speed import one_core
from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.trajectories import joint_move
from touchgoal.control.safety.limits import FR3, UR5E, RobotLimits
from touchgoal.runtime.errors import UserError

Joints = Float[np.ndarray, " n"]

NEAR = 0.2  # rad, farthest that a joint is from the solution at the start
_EDGE = 0.05  # rad from its limit in which a joint counts as near it
_CANDIDATES = 50  # postures of which the one nearest to a singularity is taken


def near_tasks(
    kinematics: Kinematics, count: int, rng: np.random.Generator
) -> Iterator[tuple[Joints, Joints]]:
    """Joint positions (rad) whose pose is to be found, and a start within `NEAR` of them.

    In turn from the whole range, with one to three joints near their limits, near a singularity.
    """
    lower, upper = kinematics.arm.lower + 1e-3, kinematics.arm.upper - 1e-3
    for k in range(count):
        q = rng.uniform(lower, upper)
        if k % 3 == 1:
            at = rng.choice(q.size, rng.integers(1, 4), replace=False)
            inwards, low = rng.uniform(0, _EDGE, at.size), rng.random(at.size) < 0.5
            q[at] = np.where(low, lower[at] + inwards, upper[at] - inwards)
        elif k % 3 == 2:
            candidates = rng.uniform(lower, upper, (_CANDIDATES, q.size))
            jacobians, _ = kinematics.jacobians(candidates)
            least = np.linalg.svd(jacobians, compute_uv=False)[:, -1]
            q = candidates[np.argmin(least)]
        yield q, np.clip(q + rng.uniform(-NEAR, NEAR, q.size), lower, upper)


def run(config: MotionOptions) -> dict[str, Any]:
    """Solve poses and time moves of both arms, on one core."""
    rows, lines = [], []
    with one_core():
        for robot in (FR3, UR5E):
            rows += [_inverse(robot, config), *_moves(robot, config)]
    for row in rows:
        figures = ", ".join(f"{name} {value}" for name, value in row.items() if name != "what")
        lines.append(f"{row['what']:<44} {figures}")
    return {"rows": rows, "table": "\n".join(lines)}


def _inverse(robot: RobotLimits, config: MotionOptions) -> dict[str, Any]:
    kinematics = Kinematics(robot.arm, robot.tool.tcp_offset)
    reached, seconds = 0, []
    for q, start in near_tasks(kinematics, config.poses, np.random.default_rng(config.seed)):
        position, rotation = kinematics.forward(q)
        begun = time.perf_counter()
        solution = kinematics.solve_ik_near(position, rotation, start)
        seconds.append(time.perf_counter() - begun)
        reached += solution.reached
    return {
        "what": f"{robot.arm.name}: inverse from {NEAR} rad off",
        "solved of " + str(config.poses): reached,
        "median ms": round(1e3 * float(np.median(seconds)), 3),
    }


def _moves(robot: RobotLimits, config: MotionOptions) -> list[dict[str, Any]]:
    """Our joint moves over ruckig's for the same constant limits."""
    rows = []
    for name, limits in (("maker's", robot.interface), ("policy's", robot.policy)):
        constant, rng = replace(limits, taper=None), np.random.default_rng(config.seed)
        q, ratios = robot.arm.home, []
        for _ in range(config.moves):
            goal = rng.uniform(limits.lower, limits.upper)
            ours = joint_move(q, goal, constant).duration
            ratios.append(ours / ruckig_duration(q, goal, constant))
            q = goal
        rows.append(
            {
                "what": f"{robot.arm.name}: duration over ruckig's, {name} limits",
                "mean": round(float(np.mean(ratios)), 3),
                "greatest": round(float(np.max(ratios)), 3),
            }
        )
    return rows


def ruckig_duration(start: Joints, goal: Joints, limits: JointLimits) -> float:
    """Seconds of the fastest move from rest to rest; each joint goes its own way in between."""
    try:
        import ruckig
    except ImportError as error:
        raise UserError(
            "ruckig is missing, which moves are compared with: pip install ruckig"
        ) from error

    wanted, found = ruckig.InputParameter(start.size), ruckig.Trajectory(start.size)
    wanted.current_position, wanted.target_position = start.tolist(), goal.tolist()
    wanted.max_velocity = limits.velocity.tolist()
    wanted.max_acceleration = limits.acceleration.tolist()
    wanted.max_jerk = limits.jerk.tolist()
    if ruckig.Ruckig(start.size).calculate(wanted, found) != ruckig.Result.Working:
        raise UserError(f"ruckig found no move to {np.round(goal, 3).tolist()} rad")
    return found.duration

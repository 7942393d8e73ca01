"""Moves sampled at 1 kHz: inside every limit, at rest at both ends, straight where they say so."""

from dataclasses import replace

import numpy as np
import pytest
import ruckig

from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.kinematics import Fr3Kinematics, Kinematics, Ur5eKinematics
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.control.motion.trajectories import (
    Trajectory,
    joint_move,
    require_inside_workspace,
    straight_line,
)
from touchgoal.control.safety import limits as robots
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import RobotLimits
from touchgoal.runtime.errors import UserError

ROBOTS = [(robots.FR3, Fr3Kinematics()), (robots.UR5E, Ur5eKinematics())]


def ruckig_duration(start: np.ndarray, goal: np.ndarray, limits: JointLimits) -> float:
    """Seconds of the fastest move from rest to rest; each joint goes its own way in between."""
    wanted, found = ruckig.InputParameter(start.size), ruckig.Trajectory(start.size)
    wanted.current_position, wanted.target_position = start.tolist(), goal.tolist()
    wanted.max_velocity = limits.velocity.tolist()
    wanted.max_acceleration = limits.acceleration.tolist()
    wanted.max_jerk = limits.jerk.tolist()
    if ruckig.Ruckig(start.size).calculate(wanted, found) != ruckig.Result.Working:
        raise AssertionError("ruckig found no move")
    return found.duration


def peak_shares(trajectory: Trajectory, limits: JointLimits) -> np.ndarray:
    """Peaks of speed, acceleration and jerk at 1 kHz, rest before and after, over their limits."""
    t = np.arange(-5, int(1e3 * trajectory.duration) + 6) * 1e-3
    q = trajectory.at(t)
    assert (q >= limits.lower - 1e-9).all() and (q <= limits.upper + 1e-9).all()
    velocity, acceleration, jerk = (np.diff(q, k, axis=0) * 1e3**k for k in (1, 2, 3))
    low, high = limits.speed_range(q[1:])
    ceiling = np.maximum(np.where(velocity > 0, high, -low), 1e-9)
    return np.array(
        [
            (np.abs(velocity) / ceiling).max(),
            (np.abs(acceleration) / limits.acceleration).max(),
            (np.abs(jerk) / limits.jerk).max(),
        ]
    )


@pytest.mark.parametrize(("robot", "arm"), ROBOTS, ids=["FR3", "UR5e"])
def test_full_speed_joint_moves_use_a_limit_up_and_exceed_none(
    robot: RobotLimits, arm: Kinematics
) -> None:
    limits, rng = robot.interface, np.random.default_rng(0)
    q = arm.arm.home
    for _ in range(40):
        goal = rng.uniform(limits.lower, limits.upper)
        move = joint_move(q, goal, limits)
        shares = peak_shares(move, limits)
        assert (shares <= 1).all() and shares.max() > 0.97
        np.testing.assert_allclose(move.at(0.0), q, atol=1e-12)
        np.testing.assert_allclose(move.at(move.duration), goal, atol=1e-12)
        q = goal


@pytest.mark.parametrize(("robot", "arm"), ROBOTS, ids=["FR3", "UR5e"])
@pytest.mark.parametrize("speed", ["interface", "policy"])
def test_moves_take_little_longer_than_the_fastest(
    robot: RobotLimits, arm: Kinematics, speed: str
) -> None:
    """Ruckig, to which constant limits can be told, lets each joint go its own way in between."""
    limits, rng = replace(getattr(robot, speed), taper=None), np.random.default_rng(0)
    q = arm.arm.home
    for k in range(60):
        goal = rng.uniform(limits.lower, limits.upper)
        if k % 3 == 0:  # short ones as well
            goal = np.clip(q + rng.uniform(-0.3, 0.3, q.size), limits.lower, limits.upper)
        assert joint_move(q, goal, limits).duration < 1.15 * ruckig_duration(q, goal, limits)
        q = goal


@pytest.mark.parametrize(("robot", "arm"), ROBOTS, ids=["FR3", "UR5e"])
def test_retreats_are_straight_and_within_limits(robot: RobotLimits, arm: Kinematics) -> None:
    limits, rng = robot.policy, np.random.default_rng(1)
    for _ in range(6):
        low = rng.uniform([0.4, -0.2, 0.03], [0.6, 0.2, 0.1])
        q = arm.solve_ik(low, fingers_down(rng.uniform(-1, 1)), arm.arm.home)
        high, rotation = low + np.array([0.05, -0.05, 0.2]), fingers_down(rng.uniform(-1, 1))
        move = straight_line(arm, q, high, rotation, limits)
        assert (peak_shares(move, limits) <= 1).all()
        poses = [arm.forward(p) for p in move.sample(50)]
        along = (high - low) / np.linalg.norm(high - low)
        points = np.array([p for p, _ in poses])
        assert np.linalg.norm(np.cross(points - points[0], along), axis=1).max() < 1e-4
        np.testing.assert_allclose(points[-1], high, atol=1e-6)
        np.testing.assert_allclose(poses[-1][1], rotation, atol=1e-6)


def test_a_move_to_the_same_place_stays() -> None:
    home = robots.FR3.arm.home
    move = joint_move(home, home, robots.FR3.policy)
    np.testing.assert_allclose(move.sample(1000), np.tile(home, (len(move.sample(1000)), 1)))


def test_what_cannot_be_done_is_refused_in_a_line() -> None:
    robot, arm = ROBOTS[0]
    home, limits = robot.arm.home, robot.policy
    with pytest.raises(UserError, match="joint 2"):
        joint_move(home, home + 3 * np.eye(7)[1], limits)
    with pytest.raises(UserError, match="cannot follow"):
        straight_line(arm, home, np.array([1.5, 0, 0.3]), fingers_down(0), limits)
    with pytest.raises(UserError, match="workspace box"):
        require_inside_workspace(
            joint_move(home, home + 1.5 * np.eye(7)[0], limits), ActionFilter(robot, 20)
        )

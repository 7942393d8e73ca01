"""Moves and the tracker at 1 kHz: inside every limit, at rest at both ends, straight where they say so."""

import numpy as np
import pytest
from both_sides import complaint, sides
from hypothesis import example, given, settings
from hypothesis import strategies as st

from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.control.motion.tracker import Tracker
from touchgoal.control.motion.trajectories import (
    Trajectory,
    joint_move,
    require_inside_workspace,
    straight_line,
)
from touchgoal.control.safety import limits as robots
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3, UR5E, RobotLimits
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.deployed_arm import measurements_at_rest

ROBOTS = [
    (robots.FR3, robots.FR3.kinematics()),
    (robots.UR5E, robots.UR5E.kinematics()),
]
BOTH = pytest.mark.parametrize(("robot", "arm"), ROBOTS, ids=["FR3", "UR5e"])
DT = 1e-3


def peak_shares(limits: JointLimits, q: np.ndarray) -> np.ndarray:
    """Peaks of speed, acceleration and jerk of positions at 1 kHz, over their limits."""
    assert (q >= limits.lower - 1e-9).all() and (q <= limits.upper + 1e-9).all()
    velocity, acceleration, jerk = (np.diff(q, k, axis=0) / DT**k for k in (1, 2, 3))
    low, high = limits.speed_range(q[1:])
    ceiling = np.maximum(np.where(velocity > 0, high, -low), 1e-9)
    shares = velocity / ceiling, acceleration / limits.acceleration, jerk / limits.jerk
    return np.array([np.abs(share).max() for share in shares])


def at_1_khz(move: Trajectory) -> np.ndarray:
    """With rest before and after."""
    return move.at(np.arange(-5, int(move.duration / DT) + 6) * DT)


@BOTH
def test_joint_moves_use_a_limit_up_and_exceed_none(robot: RobotLimits, arm: Kinematics) -> None:
    limits, rng = robot.interface, np.random.default_rng(0)
    q = arm.arm.home
    for _ in range(40):
        goal = rng.uniform(limits.lower, limits.upper)
        move = joint_move(q, goal, limits)
        shares = peak_shares(limits, at_1_khz(move))
        assert (shares <= 1).all() and shares.max() > 0.97
        np.testing.assert_allclose(move.at(0.0), q, atol=1e-12)
        np.testing.assert_allclose(move.at(move.duration), goal, atol=1e-12)
        q = goal


@BOTH
def test_retreats_are_straight_and_within_limits(robot: RobotLimits, arm: Kinematics) -> None:
    limits, rng = robot.policy, np.random.default_rng(1)
    for _ in range(6):
        low = rng.uniform([0.4, -0.2, 0.03], [0.6, 0.2, 0.1])
        q = arm.solve_ik(low, fingers_down(rng.uniform(-1, 1)), arm.arm.home)
        high, rotation = low + np.array([0.05, -0.05, 0.2]), fingers_down(rng.uniform(-1, 1))
        move = straight_line(arm, q, high, rotation, limits)
        assert (peak_shares(limits, at_1_khz(move)) <= 1).all()
        poses = [arm.forward(p) for p in move.sample(50)]
        along = (high - low) / np.linalg.norm(high - low)
        points = np.array([p for p, _ in poses])
        assert np.linalg.norm(np.cross(points - points[0], along), axis=1).max() < 1e-4
        np.testing.assert_allclose(points[-1], high, atol=1e-6)
        np.testing.assert_allclose(poses[-1][1], rotation, atol=1e-6)


def test_what_cannot_be_done_is_refused_in_a_line() -> None:
    robot, arm = ROBOTS[0]
    home, limits = robot.arm.home, robot.policy
    with pytest.raises(UserError, match="cannot follow"):
        straight_line(arm, home, np.array([1.5, 0, 0.3]), fingers_down(0), limits)
    with pytest.raises(UserError, match="workspace box"):
        require_inside_workspace(
            joint_move(home, home + 1.5 * np.eye(7)[0], limits), ActionFilter(robot, 20)
        )


def track(robot: RobotLimits, targets: list[tuple[np.ndarray, int]], hz: int = 20) -> np.ndarray:
    """Commands (rad) at 1 kHz for targets that each stand for a number of milliseconds."""
    tracker, start = Tracker(robot.interface, robot.policy.velocity, 1 / hz), robot.arm.home
    state, q = tracker.start(start), [start] * 4
    for target, ticks in targets:
        state = tracker.set_target(state, target)
        for _ in range(ticks):
            state = tracker.step(state)
            q.append(state.q)
    return np.array(q)


def check_within(limits: JointLimits, q: np.ndarray) -> None:
    assert (peak_shares(limits, q) <= 1 + 1e-6).all()


HURRIED = st.lists(
    st.tuples(st.lists(st.floats(width=64), min_size=7, max_size=7), st.integers(0, 150)),
    max_size=6,
)


@settings(max_examples=40, deadline=None)
@given(HURRIED)
@example([([2.0] * 7, 70), ([-2.0] * 7, 3), ([2.0] * 7, 1), ([-2.0] * 7, 400)])
@example([([1e308] * 7, 700), ([-1e308] * 7, 700)])
def test_no_target_at_no_time_leaves_the_limits(targets: list[tuple[list[float], int]]) -> None:
    check_within(FR3.interface, track(FR3, [(np.array(t), ticks) for t, ticks in targets]))


def test_a_policy_that_falls_silent_is_obeyed_and_not_overshot() -> None:
    for robot in (FR3, UR5E):
        home = robot.arm.home
        goal = home + np.linspace(-0.3, 0.3, home.size)
        q = track(robot, [(goal, 3000)])
        check_within(robot.interface, q)
        np.testing.assert_allclose(q[-1], goal, atol=1e-9)
        assert (q >= np.minimum(home, goal) - 1e-12).all()
        assert (q <= np.maximum(home, goal) + 1e-12).all()


def test_a_regular_policy_is_followed_without_ripple() -> None:
    """A steady 20 Hz ramp at half speed becomes a steady ramp, less than 0.1 s late."""
    step = 0.5 * FR3.policy.velocity * 0.05
    targets = [(FR3.arm.home + k * step, 50) for k in range(1, 9)]
    q = track(FR3, targets)
    velocity = np.diff(q, axis=0)[-200:] / DT
    np.testing.assert_allclose(velocity, np.tile(step / 0.05, (200, 1)), rtol=1e-3)
    late = (targets[-1][0] - q[-1]) / (step / 0.05)
    assert (late < 0.1).all()


def wild_commands(layer: ActionFilter, ticks: int, rng: np.random.Generator) -> list[np.ndarray]:
    """The filtered joint targets (rad) of a policy that pushes anywhere, often very hard."""
    state, push, commands = layer.start(layer.limits.arm.home), np.zeros(0), []
    for tick in range(ticks):
        if tick % round(1.25 / layer.dt) == 0:
            push = rng.choice([0.05, 1.0, 1e300]) * rng.standard_normal(state.q.size)
        state = layer.filter_action(state, push, measurements_at_rest(state.q))
        commands.append(state.q)
    return commands


def outside_box(layer: ActionFilter, q: np.ndarray) -> float:
    """How far (m) flange or fingers leave their boxes at worst; negative inside."""
    points, limits = layer.monitored_points(q), layer.limits
    boxes = (limits.flange, points[:, :1]), (limits.fingertips, points[:, 1:])
    return max(float(np.maximum(box.lower - p, p - box.upper).max()) for box, p in boxes)


@pytest.mark.parametrize("robot", [FR3, UR5E], ids=lambda r: r.arm.name)
@pytest.mark.parametrize("hz", [20, 125])
def test_what_is_sent_stays_in_the_box_and_inside_every_limit(robot: RobotLimits, hz: int) -> None:
    """A wild policy, a third of whose commands come late by up to a tick."""
    layer, rng = ActionFilter(robot, hz), np.random.default_rng(1)
    period, commands = 1000 // hz, wild_commands(layer, 4 * hz, rng)
    late = rng.integers(0, period, 4 * hz) * (rng.random(4 * hz) < 0.3)
    lasting = period + np.diff(late, append=0)  # ms that each command stands
    home = (robot.arm.home, int(late[0]))
    q = track(robot, [home, *zip(commands, lasting.tolist(), strict=True)], hz)
    check_within(robot.interface, q)
    assert outside_box(layer, q[::5]) < 0


def test_with_commands_lost_the_fingers_stay_in_their_box() -> None:
    """A wild policy with a tenth of its ticks lost: less than 2 mm outside, ever."""
    layer, rng = ActionFilter(FR3, 20), np.random.default_rng(1)
    targets, ticks = [], 0
    for command in wild_commands(layer, 200, rng):
        ticks += 50
        if rng.random() > 0.1:
            targets.append((command, ticks))
            ticks = 0
    q = track(FR3, targets)
    check_within(FR3.interface, q)
    assert outside_box(layer, q[::10]) < 2e-3


@sides((0.49e-3, 0.51e-3))
def test_a_line_that_bends_by_half_a_millimetre_is_refused(value: float, beyond: bool) -> None:
    class Bent(Kinematics):
        def forward_many(self, q: np.ndarray) -> tuple:
            points, *rest = super().forward_many(q)
            return points + [0, value, 0], *rest

    arm = Bent(FR3.arm, FR3.tool.tcp_offset)
    end, R = arm.forward(arm.arm.home)
    line = arm, arm.arm.home, end + [0, 0, 0.1], R, FR3.interface
    assert ("passes a singular posture" in complaint(straight_line, *line)) == beyond


def test_targets_beyond_the_range_are_cut_to_it() -> None:
    tracker = Tracker(FR3.interface, FR3.policy.velocity, 0.05)
    for far, end in ((9.0, FR3.interface.upper), (-9.0, FR3.interface.lower)):
        state = tracker.set_target(tracker.start(FR3.arm.home), FR3.arm.home + far)
        np.testing.assert_array_equal(state.targets[-1], end)

"""The tracker at 1 kHz: within every limit whatever comes when, and close to a regular policy."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from touchgoal.benchmarks.deployment.sent_stream import late_by, outside_box, send, wild_commands
from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.tracker import Tracker
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3, UR5E, RobotLimits

DT = 1e-3


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
    velocity, acceleration, jerk = (np.diff(q, k, axis=0) / DT**k for k in (1, 2, 3))
    assert (np.abs(velocity) <= limits.velocity + 1e-9).all()
    assert (np.abs(acceleration) <= limits.acceleration + 1e-6).all()
    assert (np.abs(jerk) <= limits.jerk + 1e-3).all()
    assert (q >= limits.lower - 1e-12).all() and (q <= limits.upper + 1e-12).all()


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


@pytest.mark.parametrize("robot", [FR3, UR5E], ids=lambda r: r.arm.name)
@pytest.mark.parametrize("hz", [20, 125])
def test_what_is_sent_stays_in_the_box_and_inside_every_limit(robot: RobotLimits, hz: int) -> None:
    """A wild policy, a third of whose commands come late by up to a tick."""
    layer, rng = ActionFilter(robot, hz), np.random.default_rng(1)
    commands = wild_commands(layer, 4 * hz, rng)
    late = late_by(4 * hz, 1000 // hz, rng)
    q = np.array(list(send(robot, hz, commands, late.tolist())))
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

"""The tracker at 1 kHz: within every limit whatever comes when, and close to a regular policy."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from touchgoal.control.limits import FR3, UR5E, JointLimits
from touchgoal.control.tracker import Tracker

DT = 1e-3


def track(limits: JointLimits, start: np.ndarray, targets: list[tuple[np.ndarray, int]]):
    """Commands (rad) at 1 kHz for targets that each stand for a number of milliseconds."""
    tracker = Tracker(limits, 0.05)
    state, q = tracker.start(start), [start] * 4
    for target, ticks in targets:
        state = tracker.aim(state, target)
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
    limits = FR3.hardware.inside(FR3.margin)
    q = track(limits, FR3.arm.home, [(np.array(t), ticks) for t, ticks in targets])
    check_within(limits, q)


def test_a_policy_that_falls_silent_is_obeyed_and_not_overshot() -> None:
    for robot in (FR3, UR5E):
        limits = robot.policy
        home = robot.arm.home
        goal = home + np.linspace(-0.3, 0.3, home.size)
        q = track(limits, home, [(goal, 3000)])
        check_within(limits, q)
        np.testing.assert_allclose(q[-1], goal, atol=1e-9)
        assert (q >= np.minimum(home, goal) - 1e-12).all()
        assert (q <= np.maximum(home, goal) + 1e-12).all()


def test_a_regular_policy_is_followed_without_ripple() -> None:
    """A steady 20 Hz ramp at half speed becomes a steady ramp, less than 0.1 s late."""
    limits = FR3.policy
    step = 0.5 * limits.velocity * 0.05
    targets = [(FR3.arm.home + k * step, 50) for k in range(1, 9)]
    q = track(limits, FR3.arm.home, targets)
    velocity = np.diff(q, axis=0)[-200:] / DT
    np.testing.assert_allclose(velocity, np.tile(step / 0.05, (200, 1)), rtol=1e-3)
    late = (targets[-1][0] - q[-1]) / (step / 0.05)
    assert (late < 0.1).all()

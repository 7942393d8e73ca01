"""The tracker at 1 kHz: within every limit whatever comes when, and close to a regular policy."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.motion.tracker import Tracker
from touchgoal.control.safety.action_filter import ActionFilter, Measurements
from touchgoal.control.safety.limits import FR3, UR5E

DT = 1e-3


def track(limits: JointLimits, start: np.ndarray, targets: list[tuple[np.ndarray, int]]):
    """Commands (rad) at 1 kHz for targets that each stand for a number of milliseconds."""
    tracker = Tracker(limits, 0.05)
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
    limits = FR3.interface
    q = track(limits, FR3.arm.home, [(np.array(t), ticks) for t, ticks in targets])
    check_within(limits, q)


def test_a_policy_that_falls_silent_is_obeyed_and_not_overshot() -> None:
    for robot in (FR3, UR5E):
        limits = robot.interface
        home = robot.arm.home
        goal = home + np.linspace(-0.3, 0.3, home.size)
        q = track(limits, home, [(goal, 3000)])
        check_within(limits, q)
        np.testing.assert_allclose(q[-1], goal, atol=1e-9)
        assert (q >= np.minimum(home, goal) - 1e-12).all()
        assert (q <= np.maximum(home, goal) + 1e-12).all()


def test_a_regular_policy_is_followed_without_ripple() -> None:
    """A steady 20 Hz ramp at half speed becomes a steady ramp, less than 0.1 s late."""
    limits = FR3.interface
    step = 0.5 * FR3.policy.velocity * 0.05
    targets = [(FR3.arm.home + k * step, 50) for k in range(1, 9)]
    q = track(limits, FR3.arm.home, targets)
    velocity = np.diff(q, axis=0)[-200:] / DT
    np.testing.assert_allclose(velocity, np.tile(step / 0.05, (200, 1)), rtol=1e-3)
    late = (targets[-1][0] - q[-1]) / (step / 0.05)
    assert (late < 0.1).all()


def test_behind_the_safety_layer_the_fingers_stay_in_their_box() -> None:
    """A wild policy with a tenth of its ticks lost, at 1 kHz: less than 2 mm outside, ever."""
    layer, rng = ActionFilter(FR3, 20), np.random.default_rng(1)
    state = layer.start(FR3.arm.home)
    targets, push, ticks = [], np.zeros(7), 0
    for tick in range(200):
        if tick % 25 == 0:
            push = rng.choice([0.05, 1.0]) * rng.standard_normal(7)
        calm = Measurements(state.q, np.zeros(3), np.zeros(7), np.zeros(2), *[0.0] * 4)
        state = layer.filter_action(state, push, calm)
        ticks += 50
        if rng.random() > 0.1:
            targets.append((state.q, ticks))
            ticks = 0
    q = track(FR3.interface, FR3.arm.home, targets)
    check_within(FR3.interface, q)
    fingers, box = layer.monitored_points(q[::10])[:, 1:], FR3.fingertips
    assert np.maximum(box.lower - fingers, fingers - box.upper).max() < 2e-3

"""The safety layer against whatever a policy or a sensor may say.

TOUCHGOAL_SAFETY_TICKS scales the random run (default 400 ticks of each arm; a million before a
release: half an hour of a core).
"""

import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from touchgoal.control.safety import limits as robots
from touchgoal.control.safety.action_filter import (
    ActionFilter,
    Limit,
    Measurements,
    Mode,
    SafetyState,
)
from touchgoal.control.safety.limits import RobotLimits
from touchgoal.runtime.errors import UserError

HZ = 20
TICKS = int(os.environ.get("TOUCHGOAL_SAFETY_TICKS", "400"))
LAYERS = {robot.arm.name: ActionFilter(robot, HZ) for robot in (robots.FR3, robots.UR5E)}
FR3 = LAYERS["FR3"]
BOTH_ROBOTS = pytest.mark.parametrize("robot", [robots.FR3, robots.UR5E], ids=lambda r: r.arm.name)
EPS = 1e-9


def reading(q: np.ndarray, **changes: object) -> Measurements:
    calm = Measurements(q, np.zeros(3), np.zeros(q.size), np.zeros(2), *[0.0] * 4)
    return replace(calm, **changes)  # pyright: ignore[reportArgumentType]


def check(layer: ActionFilter, path: list[SafetyState]) -> None:
    """Assert that no state after the first exceeds any limit, the maker's taper included."""
    j, dt = layer.joints, layer.dt
    q, velocity = np.stack([s.q for s in path]), np.stack([s.velocity for s in path])
    assert np.isfinite(q).all()
    assert (q >= j.lower - EPS).all() and (q <= j.upper + EPS).all()
    np.testing.assert_allclose(velocity[1:], np.diff(q, axis=0) / dt, atol=EPS)
    low, high = layer.limits.hardware.speed_range(q)
    assert (np.abs(velocity) <= j.velocity + EPS).all()
    assert ((velocity >= low) & (velocity <= high))[1:].all()
    assert (np.abs(np.diff(q, axis=0)) <= layer.limits.max_step + EPS).all()
    assert (np.abs(np.diff(velocity, axis=0)) <= j.acceleration * dt + EPS).all()
    assert layer.inside_workspace(q[1:]).all()
    points = layer.monitored_points(q)
    fastest = np.linalg.norm(np.diff(points, axis=0), axis=-1).max(axis=1) / dt
    # Braking joint by joint may bend the path a little faster for a tick.
    assert (fastest <= 1.15 * layer.limits.tip_speed).all()


def run(layer: ActionFilter, actions: list[np.ndarray]) -> SafetyState:
    path = [layer.start(layer.limits.arm.home)]
    for action in actions:
        path.append(layer.filter_action(path[-1], action, reading(path[-1].q)))
    if actions:
        check(layer, path)
    return path[-1]


def pushes(n: int) -> st.SearchStrategy:
    """Runs of one action: floats of every size, infinities and NaN among them, or full speed."""
    anything = arrays(np.float64, n, elements=st.floats(width=64))
    full = arrays(np.float64, n, elements=st.sampled_from([-1.0, -0.02, 0.0, 0.02, 1.0]))
    return st.lists(st.tuples(st.one_of(full, anything), st.integers(1, 12)), max_size=4)


@settings(max_examples=50, deadline=None)
@given(pushes(7))
@example([(np.eye(7)[1], 60)])  # shoulder over: fingers into the table
@example([(np.full(7, 1e308), 40), (np.full(7, -1e308), 40)])  # overflows a division by dt
@example([(np.eye(7)[0], 30), (np.full(7, np.nan), 1), (np.eye(7)[0], 5)])
@example([(-np.eye(7)[5], 60), (np.eye(7)[5], 120)])  # wrist through its whole range
def test_nothing_leaves_the_limits_of_the_fr3(pushes: list[tuple[np.ndarray, int]]) -> None:
    run(FR3, [action for action, ticks in pushes for _ in range(ticks)])


@settings(max_examples=30, deadline=None)
@given(pushes(6))
@example([(-np.eye(6)[1], 80)])
def test_nothing_leaves_the_limits_of_the_ur5e(pushes: list[tuple[np.ndarray, int]]) -> None:
    run(LAYERS["UR5e"], [action for action, ticks in pushes for _ in range(ticks)])


@pytest.mark.parametrize("name", LAYERS)
def test_nothing_leaves_the_limits_in_a_long_random_walk(name: str) -> None:
    layer, rng = LAYERS[name], np.random.default_rng(5)
    state, seen, n = layer.start(layer.limits.arm.home), set(), layer.joints.lower.size
    for _ in range(TICKS // 25):
        push, path = rng.choice([0.0, 0.01, 0.05, 1.0, 1e300]) * rng.standard_normal(n), [state]
        for _ in range(25):
            action = push + 0.02 * rng.standard_normal(n)
            path.append(layer.filter_action(path[-1], action, reading(path[-1].q)))
            seen |= set(path[-1].active_limits)
        check(layer, path)
        state = path[-1]
    assert {Limit.STEP, Limit.VELOCITY, Limit.ACCELERATION, Limit.WORKSPACE} <= seen


@BOTH_ROBOTS
def test_eight_corners_of_the_fingertips_stay_5_mm_above_the_table(robot: RobotLimits) -> None:
    """Turned about the approach axis the edges across the fingers come lowest: two points miss them."""
    layer = LAYERS[robot.arm.name]
    points = layer.monitored_points(robot.arm.home[None])[0]
    assert len(points) == 1 + 8 and robot.fingertips.lower[2] == 0.005
    kinematics = robot.kinematics()
    position, R = kinematics.forward(robot.arm.home)
    case = np.array([0.0145, 0.0285, 0.0165])  # half of 28.5 x 32.5 mm, and 28.3 mm behind the gel
    half = robot.tool.stroke[1] / 2
    for sign in (1, -1):
        outer = position + R @ np.array([case[0], sign * (half + case[1]), case[2]])
        assert np.linalg.norm(points[1:] - outer, axis=1).min() < 2e-3


@BOTH_ROBOTS
def test_fingertips_keep_to_their_speed(robot: RobotLimits) -> None:
    layer = ActionFilter(replace(robot, tip_speed=0.1), HZ)
    n, named = robot.arm.home.size, set()
    path = [layer.start(robot.arm.home)]
    for _ in range(30):
        path.append(layer.filter_action(path[-1], 0.05 * np.eye(n)[0], reading(path[-1].q)))
        named |= set(path[-1].active_limits)
    check(layer, path)
    assert Limit.TIP_SPEED in named
    speed = layer.tip_speed(path[-1].q, path[-1].velocity[None])[0]
    assert 0.05 < speed < 0.115


def test_a_gentle_command_passes_untouched() -> None:
    state = FR3.start(FR3.limits.arm.home)
    action = np.full(7, 0.002)
    after = FR3.filter_action(state, action, reading(state.q))
    np.testing.assert_allclose(after.q, state.q + action, atol=1e-15)
    assert after.mode is Mode.MOVE and after.active_limits == ()


def test_the_joint_margin_is_reached_and_named() -> None:
    state = FR3.start(FR3.limits.arm.home)
    named = set()
    for _ in range(150):
        state = FR3.filter_action(state, np.eye(7)[6], reading(state.q))
        named |= set(state.active_limits)
    assert state.q[6] == pytest.approx(FR3.joints.upper[6], abs=1e-9) and Limit.MARGIN in named


FAULTS = [
    ("force", np.array([0, 0, -16.0]), Limit.FORCE),
    ("torque", np.full(7, -11.0), Limit.TORQUE),
    ("indentation", np.array([0.0, 2e-3]), Limit.INDENTATION),
    ("force", np.full(3, np.nan), Limit.FORCE),
    ("q", np.full(7, np.nan), Limit.TRACKING),
    ("observation_age", 0.6, Limit.STALE_OBSERVATION),
    ("action_age", 0.6, Limit.STALE_ACTION),
    ("state_age", float("nan"), Limit.STALE_STATE),
]


@pytest.mark.parametrize(("field", "value", "limit"), FAULTS)
def test_a_fault_brakes_within_limits_and_stays(field: str, value: object, limit: Limit) -> None:
    state = run(FR3, [np.full(7, -0.02)] * 8)
    assert np.abs(state.velocity).max() > 0.3
    bad = replace(reading(state.q), **{field: value})
    for tick in range(12):
        # Later faults and calm readings change nothing.
        now = bad if tick == 0 else reading(state.q, indentation=np.full(2, 99.0 * (tick % 2)))
        after = FR3.filter_action(state, np.full(7, -0.02), now)
        check(FR3, [state, after])
        state = after
        assert state.mode is Mode.STOP and state.fault and state.fault.limit is limit
    assert (state.velocity == 0).all()


@pytest.mark.parametrize("age", ["observation_age", "action_age", "state_age"])
def test_what_is_stale_holds_then_resumes_or_stops(age: str) -> None:
    state = run(FR3, [np.full(7, 0.01)] * 3)
    held = FR3.filter_action(state, np.full(7, 0.01), reading(state.q, **{age: 0.12}))
    assert held.mode is Mode.HOLD and held.fault is None
    assert (np.abs(held.velocity) < np.abs(state.velocity)).all()
    assert FR3.filter_action(held, np.full(7, 0.01), reading(held.q)).mode is Mode.MOVE
    assert FR3.filter_action(held, np.full(7, 0.01), reading(held.q, **{age: 1.0})).fault


@BOTH_ROBOTS
def test_no_start_outside(robot: RobotLimits) -> None:
    layer = LAYERS[robot.arm.name]
    with pytest.raises(UserError, match="joint 3"):
        layer.start(np.where(np.arange(robot.arm.home.size) == 2, 9.0, robot.arm.home))
    turned = robot.arm.home.copy()
    turned[0] += 2.0
    with pytest.raises(UserError, match="workspace"):
        layer.start(turned)


@given(st.floats(width=64))
def test_the_gripper_keeps_to_its_stroke_and_holds_with_the_arm(target: float) -> None:
    start = FR3.start(FR3.limits.arm.home)
    moving = FR3.filter_action(start, np.zeros(7), reading(start.q))
    width = FR3.filter_width(moving, target, 0.03)
    assert width == (np.clip(target, 0, 0.08) if np.isfinite(target) else 0.03)
    for age in (0.2, 1.0):  # hold, stop
        held = FR3.filter_action(moving, np.zeros(7), reading(start.q, state_age=age))
        assert FR3.filter_width(held, target, 0.03) == 0.03

"""Both sides of each figure of the safety layer: just inside it nothing happens, just outside it does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from both_sides import complaint, sides
from fake_cell import SIM, write_cell_file

from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.limits import cell_limits, cell_watchdogs
from touchgoal.control.safety import limits as robots
from touchgoal.control.safety.action_filter import (
    ActionFilter,
    Deadline,
    Limit,
    Measurements,
    Mode,
    SafetyState,
    Watchdogs,
)
from touchgoal.control.safety.fingertip_health import FingertipHealth
from touchgoal.control.safety.limits import Box
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI

FR3, UR5E = ActionFilter(robots.FR3, 20), ActionFilter(robots.UR5E, 20)
HOME, E = robots.FR3.arm.home, np.eye(7)
REST = FR3.start(HOME)
CALM = Measurements(HOME, np.zeros(3), np.zeros(7), np.zeros(2), *[0.0] * 4)


def after(**reading: object) -> SafetyState:
    measured = replace(CALM, **reading)  # pyright: ignore[reportArgumentType]
    return FR3.filter_action(REST, np.zeros(7), measured)


@pytest.mark.parametrize(
    ("field", "inside", "outside", "limit"),
    [
        ("force", np.array([0.0, 0.0, -14.99]), np.array([0.0, 0.0, -15.01]), Limit.FORCE),
        ("force", np.array([9.0, 9.0, 7.9]), np.array([9.0, 9.0, 8.0]), Limit.FORCE),
        ("torque", 9.99 * E[6], 10.01 * E[6], Limit.TORQUE),
        ("torque", -9.99 * E[0], -10.01 * E[0], Limit.TORQUE),
        ("load", 14.99, 15.01, Limit.LOAD),
        ("load", -14.99, -15.01, Limit.LOAD),
        ("indentation", np.array([0.0, 1.49e-3]), np.array([0.0, 1.51e-3]), Limit.INDENTATION),
        ("q", HOME + 0.199 * E[2], HOME + 0.201 * E[2], Limit.TRACKING),
        ("q", HOME - 0.199 * E[6], HOME - 0.201 * E[6], Limit.TRACKING),
        ("observation_age", 0.5, 0.501, Limit.STALE_OBSERVATION),
        ("action_age", 0.5, 0.501, Limit.STALE_ACTION),
        ("state_age", 0.25, 0.251, Limit.STALE_STATE),
        ("gripper_age", 1.0, 1.001, Limit.STALE_GRIPPER),
    ],
)
def test_what_stops_the_arm(field: str, inside: object, outside: object, limit: Limit) -> None:
    stopped = after(**{field: outside})
    assert after(**{field: inside}).mode is not Mode.STOP
    assert stopped.mode is Mode.STOP and stopped.fault and stopped.fault.limit is limit


@pytest.mark.parametrize(
    ("field", "age"),
    [("observation_age", 0.1), ("action_age", 0.1), ("state_age", 0.05), ("gripper_age", 0.3)],
)
def test_what_holds_the_arm(field: str, age: float) -> None:
    assert after(**{field: age}).mode is Mode.MOVE
    assert after(**{field: age + 1e-3}).mode is Mode.HOLD


def test_ten_ticks_without_a_number_hold_and_eleven_stop() -> None:
    state, modes = REST, []
    for _ in range(11):
        state = FR3.filter_action(state, np.full(7, np.nan), CALM)
        modes.append(state.mode)
    assert modes == [Mode.HOLD] * 10 + [Mode.STOP]


@pytest.mark.parametrize(
    ("layer", "joint", "inside", "outside", "limit"),
    [  # rad in a tick of 0.05 s
        (FR3, 4, 0.0499, 0.0501, Limit.STEP),
        (FR3, 0, 0.02619, 0.02621, Limit.VELOCITY),  # a fifth of 2.62 rad/s
        (UR5E, 0, 0.03139, 0.03141, Limit.VELOCITY),  # of 3.14
        (FR3, 0, 0.0125 + 4e-14, 0.0125 + 6e-14, Limit.ACCELERATION),  # half of 10 rad/s^2, rounded
        (UR5E, 0, 0.006249, 0.006251, Limit.ACCELERATION),  # of 5
    ],
)
def test_what_limits_a_command(
    layer: ActionFilter, joint: int, inside: float, outside: float, limit: Limit
) -> None:
    home = layer.limits.arm.home
    calm = replace(CALM, q=home, torque=np.zeros(home.size))
    for change, limited in ((inside, False), (outside, True)):
        for sign in (1, -1):
            action = sign * change * np.eye(home.size)[joint]
            state = layer.filter_action(layer.start(home), action, calm)
            assert (limit in state.active_limits) == limited


@pytest.mark.parametrize("layer", [FR3, UR5E], ids=["FR3", "UR5e"])
def test_fingertips_go_at_half_a_metre_a_second(layer: ActionFilter) -> None:
    """The first joint turns every point around the base's axis."""
    home = layer.limits.arm.home
    fast = ActionFilter(replace(layer.limits, velocity_share=1.0, max_step=1.0), 20)
    reach = np.linalg.norm(layer.monitored_points(home[None])[0, :, :2], axis=1).max()
    calm = replace(CALM, q=home, torque=np.zeros(home.size))
    for speed, limited in ((0.4999, False), (0.5001, True)):
        # chords of that length
        turn = 2 * np.arcsin(0.05 * speed / 2 / reach) * np.eye(home.size)[0]
        state = fast.filter_action(SafetyState(home, 20 * turn), turn, calm)
        assert (state.active_limits == (Limit.TIP_SPEED,)) == limited


def test_joints_keep_a_tenth_of_a_radian_from_their_ends() -> None:
    lower, upper = robots.FR3.hardware.lower + 0.1, robots.FR3.hardware.upper - 0.1
    for off, refused in ((-1e-3, False), (1e-3, True)):
        for joint in range(7):
            for end in (lower - off, upper + off):
                said = complaint(FR3.start, np.where(E[joint] > 0, end, HOME))
                assert (f"joint {joint + 1} is at" in said) == refused


@pytest.mark.parametrize("robot", [robots.FR3, robots.UR5E], ids=["FR3", "UR5e"])
@sides((0.601e-3, 0.599e-3))
def test_points_keep_their_reserve_from_each_face(
    robot: robots.RobotLimits, value: float, beyond: bool
) -> None:
    points = ActionFilter(robot, 20).monitored_points(robot.arm.home[None])[0]
    for name, own in (("flange", points[:1]), ("fingertips", points[1:])):
        for axis in np.eye(3):
            for low, high in ((own.min(0) - value, 9), (-9, own.max(0) + value)):
                box = Box(np.where(axis, low, -9.0), np.where(axis, high, 9.0))
                layer = ActionFilter(replace(robot, **{name: box}), 20)
                assert layer.inside_workspace(robot.arm.home[None])[0] == (not beyond)


def test_the_boxes_stand_where_the_table_is() -> None:
    for robot in (robots.FR3, robots.UR5E):
        assert robot.flange.lower.tolist() == [0.15, -0.5, 0.12]
        assert robot.flange.upper.tolist() == [0.75, 0.5, 0.9]
        assert robot.fingertips.lower.tolist() == [0.15, -0.5, 0.005]
        assert robot.fingertips.upper.tolist() == [0.8, 0.5, 0.75]


def test_a_command_is_followed_as_far_as_it_may_be_in_fifths() -> None:
    for most, share in ((1, 1), (0.99, 0.8), (0.79, 0.6), (0.59, 0.4), (0.39, 0.2), (0.19, 0)):
        found = FR3._allowed_velocity(REST, np.ones(7), lambda _, v, m=most: v[:, 0] <= m)
        assert found == pytest.approx(np.full(7, share))


@pytest.mark.parametrize(
    ("task", "policy", "force", "torque"),
    [
        ("pick-place", "expert", 24.75, 14.85),
        ("bead-maze", "follower", 26.85, 16.11),
        ("of my own", "my.py:Policy", 15.0, 10.0),
    ],
)
def test_a_tasks_ceilings_stop_the_arm_before_its_reflex(
    task: str, policy: str, force: float, torque: float, tmp_path: Path
) -> None:
    """The FR3 stops itself at 30 N and 20 Nm (test_driver_figures.py)."""
    text = SIM.replace("pick-place", task).replace("expert", policy)
    text = text.replace(', objects = ["wooden_block"]', "")
    layer = ActionFilter(cell_limits(read_cell_file(write_cell_file(tmp_path, text))), 20)
    for share, stops in ((0.999, False), (1.001, True)):
        for press in ({"force": share * force * E[1, :3]}, {"torque": share * torque * E[3]}):
            state = layer.filter_action(REST, np.zeros(7), replace(CALM, **press))
            assert (state.mode is Mode.STOP) == stops


def test_no_task_may_press_harder_than_28_newtons() -> None:
    own = robots.TASK_FORCES["pick-place"]
    ceilings = [replace(own, force=force, indentation=1e-3) for force in (18.6, 18.7, 100.0)]
    assert [c.force_ceiling for c in ceilings] == pytest.approx([27.9, 28.0, 28.0])
    assert [c.torque_ceiling for c in ceilings] == pytest.approx([16.74, 16.8, 16.8])
    deepest = {name: forces.indentation_ceiling for name, forces in robots.TASK_FORCES.items()}
    assert deepest == pytest.approx({"pick-place": 3.15e-3, "bead-maze": 1.725e-3})


def test_a_cells_own_ages_stop_the_arm_at_five_times_as_much(tmp_path: Path) -> None:
    cell = read_cell_file(write_cell_file(tmp_path, SIM))
    assert cell_watchdogs(cell) == Watchdogs()
    own = replace(cell, safety=replace(cell.safety, observation_age=0.2, state_age=0.04))
    assert cell_watchdogs(own).observation == Deadline(0.2, 1.0)
    assert cell_watchdogs(own).state == Deadline(0.04, 0.2)


def test_which_images_of_a_fingertip_are_faulty_and_how_many_are_borne() -> None:
    """0.3 of the brightness, 245 counts, 12 of noise; two bad images, six unchanged ones."""
    usual = load(GELSIGHT_MINI.sensor_file).background

    def fault(*columns: float) -> str:
        row = np.resize(np.array(columns, np.uint8), 320)[:, None]
        return FingertipHealth(GELSIGHT_MINI).fault(np.tile(row, (240, 1, 3)))

    dark = 0.3 * usual.mean()
    assert not any((fault(np.ceil(dark)), fault(245), fault(100, 106)))
    assert "black" in fault(np.floor(dark)) and "overexposed" in fault(246)
    assert "noise (14 counts" in fault(100, 107)
    dies, freezes = FingertipHealth(GELSIGHT_MINI), FingertipHealth(GELSIGHT_MINI)
    said = [dies.update(np.full_like(usual, count)) for count in range(3)]
    assert [bool(word) for word in said] == [False, False, True]
    said = [freezes.update(usual) for _ in range(7)]
    assert [bool(word) for word in said] == [False] * 6 + [True]

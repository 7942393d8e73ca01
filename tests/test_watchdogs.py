"""What the control loop does about readings that go missing, and what the gripper does at a stop."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fake_cell import FakeCamera, FakeCell, FakeLoadCell

from touchgoal.control import features as ft
from touchgoal.control.deployment.hand import HandMonitor, HeldObject
from touchgoal.control.grippers.franka_hand import NonBlockingGripper
from touchgoal.control.interfaces import Actor, DriverError, GripperReading, LoadReading
from touchgoal.control.safety.limits import FR3

NAN = float("nan")


def at(tick: int, change: Callable[[], None]) -> Callable[[int], None]:
    return lambda now: change() if now == tick else None


def set_(device: object, **values: object) -> Callable[[], None]:
    def change() -> None:
        device.reading = replace(device.reading, **values)  # pyright: ignore

    return change


def test_a_gripper_that_falls_silent_holds_then_stops_the_arm() -> None:
    cell = FakeCell()
    cell.gripper.silent_from = 1.0
    ending = cell.run(lambda _: None, step=0.001)
    assert ending.stopped and "gripper age" in ending.reason
    moved = np.diff([row[ft.STATE][0] for row in cell.rows])
    assert (moved[:15] > 0).all() and (np.abs(moved[-8:]) < 1e-9).all()


@pytest.mark.parametrize(
    ("device", "values", "message"),
    [
        ("arm", {"velocity": np.full(7, NAN)}, "joint velocity not a number"),
        ("arm", {"torque": np.full(7, NAN)}, "joint torque not a number"),
        ("arm", {"wrench": np.full(6, NAN)}, "external force is unknown"),
        ("arm", {"fault": "reflex"}, "reflex"),
        ("gripper", {"width": NAN}, "gripper width not a number"),
    ],
)
def test_what_is_not_a_number_stops_arm_and_gripper_and_never_reaches_the_record(
    device: str, values: dict, message: str
) -> None:
    cell = FakeCell()
    ending = cell.run(at(10, set_(getattr(cell, device), **values)), step=0.001)
    assert ending.stopped and message in ending.reason and np.isfinite(ending.rest_seconds)
    assert cell.arm.stopped and cell.gripper.commands[-1] == "stop"
    assert len(cell.rows) >= 10
    assert all(np.isfinite(value).all() for row in cell.rows for value in row.values())


def test_a_moment_without_numbers_is_bridged() -> None:
    cell = FakeCell()

    def each(tick: int) -> None:
        set_(cell.arm, velocity=np.full(7, NAN if tick == 10 else 0.0))()

    ending = cell.run(each, step=0.001, seconds=2.0)
    assert not ending.stopped and len(cell.rows) > 30


def test_what_presses_on_the_table_is_recorded_and_stops_the_arm() -> None:
    """More by the task's force ceiling than what lay there at first; a sudden relief counts, too."""
    for change in (40.0, -40.0):
        cell = FakeCell()
        cell.load_cell = FakeLoadCell(cell.clock, force=55.0)
        ending = cell.run(at(10, lambda c=cell, n=change: setattr(c.load_cell, "force", 55 + n)))
        assert ending.stopped and "load on the table 40" in ending.reason
        assert [row[ft.LOAD].item() for row in cell.rows] == [55.0] * len(cell.rows)


def test_a_policy_is_told_how_old_its_observation_is() -> None:
    cell = FakeCell()
    camera = FakeCamera(cell.clock, np.zeros(ft.CAMERA_SHAPE, np.uint8))
    cell.cameras[ft.FRONT] = camera
    ending = cell.run(at(10, lambda: setattr(camera, "late", 0.08)), step=0.001, seconds=1.0)
    assert not ending.stopped
    ages = [row[ft.AGE].item() for row in cell.rows]
    assert ages == pytest.approx([0.0] * 10 + [0.08] * (len(ages) - 10)) and len(ages) > 15


def test_an_arm_that_took_other_devices_along_is_what_the_operator_reads() -> None:
    cell = FakeCell()
    cell.load_cell = FakeLoadCell(cell.clock)

    def power_cut() -> None:
        set_(cell.arm, fault="the controller closed the connection")()
        cell.load_cell = None

    def read() -> LoadReading:
        if cell.load_cell is None:
            raise DriverError("load cell: device disconnected")
        return LoadReading(0.0, 0, cell.clock.time)

    cell.load_cell.read = read  # pyright: ignore
    cell.arm.reading = replace(cell.arm.reading, fault="")
    # The load cell says so first: the arm's driver has not noticed yet when it is read.
    cell.arm.stop = power_cut  # pyright: ignore
    ending = cell.run(at(10, lambda: setattr(cell, "load_cell", None)))
    assert ending.reason.startswith("arm: the controller closed the connection; also: load cell")


def test_a_dry_run_imagines_one_consistent_arm() -> None:
    cell = FakeCell()
    set_(cell.arm, wrench=np.full(6, 2.0))()
    ending = cell.run(lambda _: None, step=0.01, seconds=1.0, width=0.06, execute=False)
    assert not ending.stopped and not cell.gripper.commands
    kinematics = FR3.kinematics()
    for row in cell.rows:
        position, _ = kinematics.forward(row[ft.STATE][:7].astype(float))
        np.testing.assert_allclose(row[ft.TCP_POSE][:3], position, atol=1e-5)
        assert not row[ft.WRENCH].any()
    first, last = cell.rows[0], cell.rows[-1]
    assert np.linalg.norm(last[ft.TCP_POSE][:3] - first[ft.TCP_POSE][:3]) > 0.02
    assert last[ft.STATE][-1] == pytest.approx(0.06)


def test_an_object_lost_on_the_way_stops_the_arm() -> None:
    cell = FakeCell()
    set_(cell.gripper, width=0.04, grasped=True)()
    ending = cell.run(at(20, set_(cell.gripper, width=0.0, grasped=False)))
    assert ending.stopped and "lost its object" in ending.reason


class Recovers(Actor):
    recovers = True
    ticks = 0

    def __init__(self, cell: FakeCell) -> None:
        self.lose = at(20, set_(cell.gripper, width=0.0, grasped=False))

    def act(self, observation: dict) -> np.ndarray:
        self.ticks += 1
        self.lose(self.ticks)
        self.given_up = "it is gone" if self.ticks == 30 else ""
        return np.array([*[0.0] * 7, 0.04])


def test_a_policy_that_recovers_goes_on_until_it_gives_up() -> None:
    cell = FakeCell()
    set_(cell.gripper, width=0.04, grasped=True)()
    ending = cell.run(lambda _: None, actor=Recovers(cell))
    assert len(cell.rows) == 30 and not ending.stopped
    assert (ending.reason, ending.done) == ("it is gone", False)


def reading(width: float, grasped: bool) -> GripperReading:
    return GripperReading(width, grasped, "", 0.0)


def test_opening_the_hand_loses_nothing_and_lifting_is_carrying() -> None:
    held = HeldObject()
    held.update(reading(0.05, False), 0.0, 0.10)
    for _ in range(3):
        held.update(reading(0.04, True), 0.0, 0.10)
    assert not held.carried  # the table carries it
    held.update(reading(0.04, True), 0.0, 0.12)
    assert held.carried
    held.update(reading(0.04, False), 0.0, 0.12)  # for a moment
    held.update(reading(0.04, True), 0.0, 0.12)
    held.update(reading(0.045, False), 0.06, 0.10)
    assert not held.lost and not held.carried


def hand_fault(
    readings: list[tuple[float, bool]], commanded: float, indentation: float | None = 0.5e-3
) -> str:
    """Return the first fault for these readings (width, grasped), one a tick of 50 ms."""
    monitor = HandMonitor(FR3.tool)
    touched = None if indentation is None else np.full(2, indentation)
    faults = (
        monitor.update(reading(width, grasped), commanded, 0.05 * (tick - 1), touched, 0.05 * tick)
        for tick, (width, grasped) in enumerate(readings)
    )
    return next((fault for fault in faults if fault), "")


def test_a_hand_that_does_not_follow_is_found_and_one_that_does_is_left_alone() -> None:
    closing = [(0.08 - 0.005 * k, False) for k in range(17)]
    dead, jammed = [(0.08, False)] * 40, [*closing[:7], *[(0.05, True)] * 40]
    assert "commanded 0 mm, is 80 mm for 1.3 s" in hand_fault(dead, 0.0)
    assert "commanded 80 mm, is 0 mm" in hand_fault([(0.0, False)] * 40, 0.08)
    assert "object 50 mm wide, but neither fingertip" in hand_fault(jammed, 0.0, 0.0)
    assert "commanded 0 mm, is 50 mm" in hand_fault([(w, False) for w, _ in jammed], 0.0, 0.0)
    assert not hand_fault([*closing, *[(0.0, False)] * 40], 0.0)  # on nothing
    for touched in (0.5e-3, None):  # on an object; without fingertips
        assert not hand_fault([*closing[:9], *[(0.04, True)] * 40], 0.0, touched)
    assert not hand_fault([(0.066, False)] * 40, 0.08)  # homed with fingertips mounted


def test_a_dead_hand_stops_the_arm() -> None:
    cell = FakeCell()
    set_(cell.gripper, width=0.08)()
    ending = cell.run(lambda _: None, step=0.001, width=0.0)
    assert ending.stopped and "the hand does not follow" in ending.reason
    assert "check its cable" in ending.advice


class Slow:
    """A gripper whose readings take a while, and that counts what comes after a stop."""

    def __init__(self) -> None:
        self.stopped, self.late = threading.Event(), 0

    def read(self) -> GripperReading:
        time.sleep(0.003)
        return reading(0.04, False)

    def command(self, width: float) -> None:
        self.late += self.stopped.is_set()

    def stop(self, release_to: float | None = None) -> None:
        self.stopped.set()

    def close(self) -> None: ...


def test_a_stopped_gripper_is_sent_no_width_again() -> None:
    for _ in range(20):
        slow = Slow()
        gripper = NonBlockingGripper(slow)
        gripper.read()
        gripper.command(0.02)
        gripper.stop()
        with pytest.raises(DriverError, match="stopped"):
            gripper.command(0.03)
        time.sleep(0.01)
        gripper.close()
        assert slow.late == 0

"""Both sides of each figure of the control loop, on fake devices with a simulated clock."""

import inspect
import shutil
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from both_sides import complaint, sides
from fake_cell import (
    SIM,
    FakeArm,
    FakeCamera,
    FakeCell,
    FakeFingertip,
    FakeLoadCell,
    KeptTicks,
    write_cell_file,
)

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.deployment import control_loop, preflight, scripted, session
from touchgoal.control.deployment.control_loop import ControlLoop, Ending
from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.deployment.hand import HeldObject
from touchgoal.control.deployment.manual import ManualControl
from touchgoal.control.deployment.observation import ObservationReader
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.control.deployment.scripted import PickPlacePoses, PlannedMove, ScriptedActor
from touchgoal.control.interfaces import ArmReading, Frame, GripperReading, LoadReading, Planner
from touchgoal.control.motion.trajectories import joint_move
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI

Patch = pytest.MonkeyPatch
E, HOME, SAFETY = np.eye(7), FR3.arm.home, ActionFilter(FR3, 20)
KINEMATICS = FR3.kinematics()
GEL = load(GELSIGHT_MINI.sensor_file).background
QUIET = {"operator_request": lambda: "", "on_tick": lambda _: None}


@dataclass
class Arm(FakeArm):
    """An arm whose state is `late` (s), whose clock goes at a `pace`, and that coasts after a stop."""

    late: float = 0.0
    pace: float = 1.0
    speed: float = 0.0  # rad/s, from the stop for `coasts` s
    coasts: float = np.inf
    reports: bool = True  # that speed
    lag: float = 0.0  # rad behind what is commanded

    def read(self) -> ArmReading:
        now, q, speed = self.clock.time, self.reading.q, self.reading.velocity
        if self.stopped:
            speed = self.speed * (now - self._since < self.coasts) * E[0]
            q, speed = q + now * speed, speed if self.reports else np.full(7, np.nan)
        known = {"stamp": now - self.late, "time": self.pace * now}
        return replace(self.reading, q=q, velocity=speed, **known)

    def command(self, q: np.ndarray) -> None:
        super().command(q - self.lag * E[0])

    def stop(self) -> None:
        super().stop()
        self._since = self.clock.time


class Load(FakeLoadCell):
    """A load cell that gave its last good line `force` s ago."""

    def read(self) -> LoadReading:
        return LoadReading(0.0, 0, self.clock.time - self.force)


class Paced(FakeCamera):
    """A camera that takes `rate` images a second."""

    def read(self) -> Frame:
        return Frame(self.image, round(self.rate * self.clock.time), self.clock.time)


def with_arm(**values: Any) -> FakeCell:
    cell = FakeCell()
    cell.arm = Arm(cell.clock, **values)
    return cell


def hold(cell: FakeCell, width: float, grasped: bool = False) -> None:
    cell.gripper.reading = replace(cell.gripper.reading, width=width, grasped=grasped)


class Fingertip(FakeFingertip):
    """An untouched one whose image flickers by a count from tick to tick."""

    settles = 0.0  # s, in which its light doubles

    def read(self) -> Frame:
        sequence, left = round(1000 * self.clock.time), max(0.0, self.settles - self.clock.time)
        image = (self.image * (1 - 0.5 * left / max(self.settles, 1))).astype(np.uint8)
        return Frame(image + np.uint8(sequence // 50 % 2), sequence, self.clock.time)


def hand(width: float, asked: float, seconds: float = 2.0, creeping: float = 0.0) -> Ending:
    cell = FakeCell()
    hold(cell, width)
    each = lambda tick: hold(cell, width - creeping * tick / 20)  # noqa: E731
    return cell.run(each, width=asked, seconds=seconds)


def untouched(seconds: float) -> Ending:
    cell = FakeCell()
    cell.cameras = {key: Fingertip(cell.clock) for key in ft.TACTILE}
    return cell.run(lambda tick: hold(cell, 0.04, tick >= 3), seconds=seconds)


def slipping(ticks: int, width: float) -> Ending:
    cell = FakeCell()

    def each(tick: int) -> None:
        if tick in (20, 20 + ticks):
            hold(cell, 0.04 if tick == 20 else width, tick == 20)

    return cell.run(each, seconds=2.0)


def silent_load_cell(age: float) -> Ending:
    cell = FakeCell()
    cell.load_cell = Load(cell.clock, age)
    return cell.run(lambda _: None, seconds=1.0)


@pytest.mark.parametrize(
    ("run", "inside", "outside", "says"),
    [
        (lambda w: hand(w, 0.0), 0.0029, 0.0031, "does not follow"),  # closed
        (lambda w: hand(w, 0.08), 0.0601, 0.0599, "does not follow"),  # open
        # 0.8 s of motion, 0.5 to react
        (lambda s: hand(0.08, 0.0, s), 1.2, 1.4, "does not follow"),
        (lambda v: hand(0.06, 0.0, 3.0, v), 0.82e-3, 0.7e-3, "does not follow"),  # 1 mm in 1.3 s
        (untouched, 1.3, 1.5, "neither fingertip"),
        (lambda n: slipping(n, 0.0), 1, 2, "lost its object"),
        (lambda w: slipping(2, w), 0.0371, 0.0369, "lost its object"),
        (silent_load_cell, 0.49, 0.51, "load cell"),
    ],
)
def test_what_ends_a_run(run: Callable, inside: float, outside: float, says: str) -> None:
    assert run(inside).reason.startswith("time is up") and says in run(outside).reason


@sides((0.1049, 0.1051))
def test_an_object_is_carried_five_millimetres_above_its_grasp(value: float, beyond: bool) -> None:
    held = HeldObject()
    for z, grasped in ((0.1, False), (0.1, True), (0.1, True), (value, True)):
        held.update(GripperReading(0.04, grasped, "", 0.0), 0.0, z)
    assert held.carried == beyond


@pytest.mark.parametrize(
    ("width", "held_since", "sent"),
    [(0.04, 99, "open to 0.043"), (0.079, 99, "open to 0.080"), (0.04, 9, "open to 0.043"), (0.04, 0, "stop")],
)  # fmt: skip
def test_a_gel_pressed_too_deep_is_let_go_unless_the_object_would_fall(
    width: float, held_since: int, sent: str, monkeypatch: Patch
) -> None:
    """It may be in the air if it was held before the first tick."""
    cell, depth = FakeCell(), np.zeros(2)
    monkeypatch.setattr(ObservationReader, "_indentation", lambda *_: (depth, ""))
    hold(cell, width, held_since == 0)

    def each(tick: int) -> None:
        hold(cell, width, tick >= held_since)
        depth[:] = 2e-3 * (tick >= 15)

    reason = cell.run(each, width=width).reason
    assert "gel indentation" in reason and cell.gripper.commands[-1] == sent


def test_missed_ticks_are_not_made_up_for() -> None:
    """Four ticks that take 0.2 s each."""
    cell = FakeCell()
    cell.run(lambda tick: cell.clock.wait(cell.clock.time + 0.2 * (5 <= tick < 9)), seconds=2.0)
    assert 26 <= len(cell.rows) <= 31


@pytest.mark.parametrize("reports", [True, False])  # else from differences
@pytest.mark.parametrize("coasts", [False, True])
@sides((0.99, 1.01))
def test_an_arm_rests_below_a_hundredth_of_a_radian_a_second_within_three_seconds(
    value: float, beyond: bool, coasts: bool, reports: bool
) -> None:
    how = {"speed": 1.0, "coasts": 3 * value} if coasts else {"speed": 0.01 * value}
    loop = ControlLoop(with_arm(reports=reports, **how).connection(), SAFETY, True, **QUIET)
    assert np.isfinite(loop.stop("", "").rest_seconds) != beyond


@sides((8, 9))
def test_a_clock_that_stands_still_is_watched_for_ten_looks_at_a_second_each(
    value: int, beyond: bool, monkeypatch: Patch
) -> None:
    cell, wall = FakeCell(), iter(range(99))
    loop = ControlLoop(cell.connection(), SAFETY, True, **QUIET)
    still = cell.arm.reading
    speeds = (replace(still, velocity=(n < value) * E[0], time=1.0 * n) for n in range(99))
    monkeypatch.setattr(cell.arm, "read", lambda: next(speeds))
    monkeypatch.setattr(cell.clock, "wait", lambda _: None)
    monkeypatch.setattr(control_loop, "time", SimpleNamespace(monotonic=lambda: next(wall)))
    assert np.isfinite(loop.stop("", "").rest_seconds) != beyond


@pytest.mark.parametrize(
    ("pace", "tick", "slow"),
    [(0.96, 40, False), (0.94, 40, True), (0.5, 18, False), (0.5, 23, True)],  # the first second
)
def test_a_twin_below_95_percent_of_real_time_is_named(pace: float, tick: int, slow: bool) -> None:
    cell = with_arm(pace=pace)
    pressed = replace(cell.arm.reading, wrench=20.0 * np.eye(6)[2])
    ending = cell.run(lambda now: setattr(cell.arm, "reading", pressed) if now == tick else None)
    assert "force 20" in ending.reason and ("cannot keep up" in ending.advice) == slow


@pytest.mark.parametrize(
    ("what", "inside", "outside", "says"),
    [
        ("velocity", 0.049, 0.051, "it moves"),
        ("wrench", 7.49, 7.51, "at rest"),
        ("wrench", 7.49, np.nan, "near a singularity"),
        ("late", 0.25, 0.26, "0.26 s old"),
        ("tcp", 9.99e-3, 10.01e-3, "is it no FR3?"),  # m from where the controller has it
        ("rate", 24.0, 23.0, "23.0 images a second instead of 30"),
        ("counts", 11.9, 12.1, "looks touched (12 counts)"),
        ("settles", 9.2, 9.8, "its light still changes after 10 s"),
        ("disk", 1.551e9, 1.549e9, "make room for 1.6 GB"),  # 500 MB, and 35 MB for each of 30 s
    ],
)
def test_what_preflight_lets_pass(
    what: str, inside: float, outside: float, says: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    tips = 'fingertips = { sensor = "gelsight_mini", left = "http://l", right = "http://r" }\n'
    config = read_cell_file(write_cell_file(tmp_path, SIM + tips))
    monkeypatch.setattr(preflight, "require_readable", lambda *_: None)
    for value, refused in ((inside, False), (outside, True)):
        given = {"rate": 30.0, "late": 0.0, "counts": 0.0, "disk": 1e12, "settles": 0.0}
        given[what] = value
        cell = with_arm(late=given["late"])
        if what == "tcp":
            there, _ = KINEMATICS.forward(HOME)
            cell.arm.reading = replace(cell.arm.reading, tcp=there + value * E[1, :3])
        if what in ("velocity", "wrench"):
            changed = value * np.eye(len(getattr(cell.arm.reading, what)))[2]
            cell.arm.reading = replace(cell.arm.reading, **{what: changed})
        cell.cameras = {key: Fingertip(cell.clock) for key in ft.TACTILE}
        cell.cameras[ft.TACTILE[1]].settles = given["settles"]
        cell.cameras[ft.FRONT] = Paced(cell.clock, GEL, given["rate"])
        strength = np.array([given["counts"]])
        monkeypatch.setattr(preflight, "contact_strength", lambda *_, found=strength: found)
        disk = SimpleNamespace(free=given["disk"])
        monkeypatch.setattr(shutil, "disk_usage", lambda _, disk=disk: disk)
        lines = preflight.preflight(config, cell.connection(), SAFETY, tmp_path, lambda: 0)
        remedies = "; ".join(line.remedy for line in lines if not line.ok)
        assert (says in remedies) == refused == bool(remedies)


def deployed(cell: FakeCell, folder: Path, off: float = 0.0, **parts: object) -> session.Session:
    """A run that begins with a move to a start pose `off` (rad), and whose plan is over at once."""
    start = (HOME + off * E[0]).tolist()
    file = write_cell_file(folder, SIM.replace("seed = 3", f"start = {start}"))
    given = read_cell_file(file), replace(cell.connection(), **parts), SAFETY, KeptTicks(), True
    return session.Session(*given, lambda loop: ScriptedActor([], loop.commanded, 20), **QUIET)


@sides((0.099, 0.101))
def test_a_start_pose_near_by_is_not_moved_to(value: float, beyond: bool, tmp_path: Path) -> None:
    cell = FakeCell()
    deployed(cell, tmp_path, value).run()
    assert np.abs(cell.arm.reading.q - HOME - beyond * value * E[0]).max() < 1e-3


@sides((0.0199, 0.0201))
def test_a_start_pose_is_met_within_two_hundredths_of_a_radian(
    value: float, beyond: bool, tmp_path: Path, monkeypatch: Patch
) -> None:
    move, off = scripted.start_move, value * E[0]
    monkeypatch.setattr(session, "start_move", lambda goal, *rest: move(goal - off, *rest))
    ending = deployed(FakeCell(), tmp_path, 0.3).run().ending
    assert ending.stopped == beyond == ("missed by 0.020" in ending.reason)


def test_a_start_move_that_waits_for_the_arm_ends_after_a_minute(tmp_path: Path) -> None:
    assert deployed(with_arm(lag=0.15), tmp_path, 0.3).run().ending.reason == "time is up (60 s)"


@sides((1.9, 2.1))
def test_a_simulator_has_two_seconds_to_see_success(
    value: float, beyond: bool, tmp_path: Path
) -> None:
    cell = FakeCell()
    truth = lambda: {"success": cell.clock.time >= value, "progress": 0.0}  # noqa: E731
    assert deployed(cell, tmp_path, truth=truth)._success(Ending("over")) != beyond


@pytest.mark.parametrize(
    ("kind", "field", "inside", "outside"),
    [
        ("path", "lag", 0.119, 0.121),  # rad between command and arm
        ("path", "off", 0.0199, 0.0201),  # rad between path and command
        ("wait", "lag", 0.0199, 0.0201),
        ("wait", "creep", 0.49e-3, 0.51e-3),  # m a tick, of the hand
        ("probe", "press", 2.51, 2.49),  # N by which the table carries more
    ],
)
def test_a_plan_goes_on_while_arm_and_hand_follow(
    kind: str, field: str, inside: float, outside: float
) -> None:
    path = joint_move(HOME, HOME + 1e-4 * E[0], SAFETY.joints)
    for value, done in ((inside, True), (outside, False)):
        given = {"lag": 0.15 * (kind == "probe"), "off": 0.0, "creep": 0.0, "press": 0.0}
        given[field] = value
        q = HOME + given["off"] * E[0]
        move = PlannedMove(None if kind == "wait" else path, 0.0, 0.2, kind == "probe")
        actor = ScriptedActor([move], lambda q=q: q, 20)
        for tick in range(12):
            state = np.concatenate([q - given["lag"] * E[0], np.zeros(7), [given["creep"] * tick]])
            wrench = given["press"] * (tick > 0) * np.eye(6)[2]
            action = actor.act({ft.STATE: state, ft.WRENCH: wrench})
            if kind == "probe" and done and tick == 1:
                assert action[0] == pytest.approx(-0.15), "the measured joints are commanded"
        assert actor.done == done


def moves_of(actor: ScriptedActor) -> list[PlannedMove]:
    return inspect.getgeneratorlocals(cast(Generator, actor._actions))["moves"]


def test_what_pick_and_place_plans() -> None:
    planned = []
    for height in (0.05, 0.0):  # the box's floor is 5.6 mm up, the fingers reach 16.5 mm below
        place = PickPlacePoses((0.45, 0.0, height, 0.0), (0.5, 0.1))
        actor = scripted.pick_and_place(place, SAFETY, lambda: HOME)
        planned += moves_of(actor)
    ends = [m.path and KINEMATICS.forward(m.path.at(m.path.duration))[0][2] for m in planned]
    high = [0.17, 0.05, None, 0.17, 0.17, 0.054, 0.046, None]
    low = [0.1441, 0.0241, None, 0.1441, 0.1441, 0.0281, 0.0228, None]
    assert ends == [z and pytest.approx(z, abs=1e-6) for z in high + low]
    assert [m.width for m in planned[:8]] == [0.08, 0.08, *[0.0] * 6]
    assert [planned[i].seconds for i in (2, 6, 7)] == [1.0, 3.0, 0.8]
    paths = [m.path.sample(1000) for m in planned if m.path]
    fastest = max((np.abs(np.diff(q, axis=0)) * 1000 / FR3.policy.velocity).max() for q in paths)
    assert 0.85 < fastest <= 0.9
    start = scripted.start_move(HOME + 0.6 * E[0], 0.04, SAFETY, lambda: HOME)
    (path,) = [m.path.sample(1000) for m in moves_of(start) if m.path]
    assert 0.29 < np.abs(np.diff(path, axis=0)).max() * 1000 / (0.2 * 2.62) <= 0.3


def test_the_follower_goes_along_the_wire_and_yields_across_it() -> None:
    """25 mm/s, 2 mm/s for each newton, a quarter of a second of memory, at most 6 mm ahead."""
    actor, command, (tcp, R) = WireFollower(20), HOME.copy(), KINEMATICS.forward(HOME)

    def step(measured: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Where the next command leads, along the hand's axes."""
        state = np.concatenate([measured, np.zeros(8)])
        command[:] += actor.act({ft.STATE: state, ft.WRENCH: np.append(R @ force, [0, 0, 0])})[:7]
        return R.T @ (KINEMATICS.forward(command)[0] - tcp)

    none, across = np.zeros(3), np.array([5.0, 10.0, 0.0])
    assert not any(step(HOME, none).any() for _ in range(10)), "the hand closes for half a second"
    assert step(HOME, across) == pytest.approx([1.25e-3, 1e-3, 0.0], abs=5e-6)
    ahead = [np.linalg.norm(step(HOME, none)) for _ in range(8)]
    assert ahead[-1] == pytest.approx(6e-3, abs=1e-5)
    before, aside = actor._velocity @ R, np.append(2e-3 * R[:, 1], [0, 0, 0])
    step(HOME + KINEMATICS.joint_change(HOME, aside), none)
    assert actor._velocity @ R == pytest.approx(0.8 * before + [0, 8e-3, 0], abs=5e-5)


@sides((0.9e-3, 1.1e-3))
def test_the_arm_is_moved_by_hand_beyond_a_thousandth(
    value: float, beyond: bool, tmp_path: Path
) -> None:
    cell = FakeCell()
    config = read_cell_file(write_cell_file(tmp_path, SIM))
    manual = ManualControl(config, cell.connection(), **QUIET)
    manual.move_arm(HOME + value * E[0])
    assert (cell.arm.reading.q[0] > HOME[0]) == beyond
    begin = cell.clock.time
    manual.move_hand(opened=True)
    assert 1.0 <= cell.clock.time - begin < 1.15, "a second of standing still"


def test_how_long_a_plan_is_waited_for_and_that_a_hung_one_ages(monkeypatch: Patch) -> None:
    """20 s for the first, half a tick for the others, 2 s at the end."""
    hung, planner, waits, ages = threading.Event(), Planner(), [], []
    actor = RealTimeActor(planner)
    planner.plan = lambda _: (waits and ages and hung.wait(), np.zeros((1, 8), np.float32))[1]
    wait, join = actor._condition.wait_for, actor._thread.join

    def noted(holds: Callable, timeout: float | None = None) -> bool:
        waits.append(timeout)
        return wait(holds, timeout)

    monkeypatch.setattr(actor._condition, "wait_for", noted)
    for _ in range(4):
        actor.act({})
        ages.append(actor.action_age)
    hung.set()
    monkeypatch.setattr(actor._thread, "join", lambda seconds: waits.append(seconds) or join(5))
    actor.close()
    assert set(waits) == {None, 20.0, 0.025, 2.0} and ages == pytest.approx([0.0, 0.05, 0.1, 0.15])
    late = RealTimeActor(planner)
    monkeypatch.setattr(late._condition, "wait_for", lambda *_: False)
    monkeypatch.setattr(late._thread, "start", lambda: None)
    assert "no plan in 20 s" in complaint(late.start, {})


@sides((0.99e-3, 1.01e-3))
def test_a_calibration_of_the_arms_own_is_said_from_a_millimetre_on(
    value: float, beyond: bool
) -> None:
    cell, (there, _) = FakeCell(), KINEMATICS.forward(HOME)
    cell.arm.reading = replace(cell.arm.reading, tcp=there + value * E[0, :3])
    assert ("own calibration is not used" in preflight._kinematics(cell.connection())) == beyond

"""Both sides of each figure of the control loop, on fake devices with a simulated clock."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_cell import SIM, FakeArm, FakeCamera, FakeCell, FakeLoadCell, write_cell_file

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.deployment import control_loop, preflight, scripted, session
from touchgoal.control.deployment.control_loop import ControlLoop
from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.deployment.hand import HeldObject
from touchgoal.control.deployment.manual import ManualControl
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.control.deployment.scripted import PickPlacePoses, PlannedMove, ScriptedActor
from touchgoal.control.interfaces import ArmReading, Frame, GripperReading, LoadReading
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.trajectories import joint_move
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.control.sensors.tactile_camera import NO_CROP, TactileCamera
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.runtime.errors import UserError

Patch = pytest.MonkeyPatch
E, HOME = np.eye(7), FR3.arm.home
SAFETY = ActionFilter(FR3, 20)
KINEMATICS = Kinematics(FR3.arm, FR3.tool.tcp_offset)
QUIET = {"operator_request": lambda: "", "on_tick": lambda _: None}


def hold(cell: FakeCell, width: float, grasped: bool = False) -> None:
    cell.gripper.reading = replace(cell.gripper.reading, width=width, grasped=grasped)


@dataclass
class Arm(FakeArm):
    """An arm whose state is `late` (s), whose clock goes at a pace, and that coasts after a stop."""

    late: float = 0.0
    pace: float = 1.0
    speed: float = 0.0  # rad/s, from the stop for `coasts` s
    coasts: float = np.inf
    reports: bool = True
    lag: float = 0.0  # rad behind what is commanded

    def read(self) -> ArmReading:
        now = self.clock.time
        moves = self.stopped and now - self._since < self.coasts
        speed = self.speed * moves * E[0]
        q = self.reading.q + now * speed
        speed = speed if self.reports or not self.stopped else np.full(7, np.nan)
        known = {"stamp": now - self.late, "time": self.pace * now}
        return replace(self.reading, q=q, **({"velocity": speed} if self.stopped else {}), **known)

    def command(self, q: np.ndarray) -> None:
        super().command(q - self.lag * E[0])

    def stop(self) -> None:
        super().stop()
        self._since = self.clock.time


def with_arm(**values: float) -> FakeCell:
    cell = FakeCell()
    cell.arm = Arm(cell.clock, **values)
    return cell


class Load(FakeLoadCell):
    """A load cell that gave its last good line some time ago (s): its force."""

    def read(self) -> LoadReading:
        return LoadReading(0.0, 0, self.clock.time - self.force)


def hand(width: float, asked: float, seconds: float = 2.0) -> str:
    cell = FakeCell()
    hold(cell, width)
    return cell.run(lambda _: None, width=asked, seconds=seconds).reason


def creeping(speed: float) -> str:
    cell = FakeCell()
    hold(cell, 0.06)
    return cell.run(lambda tick: hold(cell, 0.06 - speed * tick / 20), width=0.0, seconds=3).reason


def untouched(seconds: float) -> str:
    cell = FakeCell()
    gel = load(GELSIGHT_MINI.sensor_file).background
    for key in ft.TACTILE:
        cell.cameras[key] = TactileCamera(FakeCamera(cell.clock, gel), GELSIGHT_MINI, NO_CROP)
    held = {3: lambda: hold(cell, 0.04, True)}
    return cell.run(lambda tick: held.get(tick, lambda: None)(), seconds=seconds).reason


def slipping(ticks: int, width: float) -> str:
    cell = FakeCell()

    def each(tick: int) -> None:
        if tick in (20, 20 + ticks):
            hold(cell, *((0.04, True) if tick == 20 else (width, False)))

    return cell.run(each, seconds=2.0).reason


def silent_load_cell(age: float) -> str:
    cell = FakeCell()
    cell.load_cell = Load(cell.clock, age)
    return cell.run(lambda _: None, seconds=1.0).reason


@pytest.mark.parametrize(
    ("reason", "inside", "outside", "says"),
    [
        (lambda w: hand(w, 0.0), 0.0029, 0.0031, "does not follow"),  # closed
        (lambda w: hand(w, 0.08), 0.0601, 0.0599, "does not follow"),  # open
        (
            lambda s: hand(0.08, 0.0, s),
            1.2,
            1.4,
            "does not follow",
        ),  # 0.8 s of motion, 0.5 to react
        (untouched, 1.3, 1.5, "neither fingertip"),
        (
            creeping,
            0.82e-3,
            0.70e-3,
            "does not follow",
        ),  # a millimetre in less, and more, than 1.3 s
        (lambda n: slipping(n, 0.0), 1, 2, "lost its object"),
        (lambda w: slipping(2, w), 0.0371, 0.0369, "lost its object"),
        (silent_load_cell, 0.49, 0.51, "load cell"),
    ],
)
def test_what_ends_a_run(reason: Callable, inside: float, outside: float, says: str) -> None:
    assert reason(inside).startswith("time is up") and says in reason(outside)


@pytest.mark.parametrize(("height", "carried"), [(0.1049, False), (0.1051, True)])
def test_an_object_is_carried_five_millimetres_above_its_grasp(
    height: float, carried: bool
) -> None:
    held = HeldObject()
    for z, grasped in ((0.1, False), (0.1, True), (0.1, True), (height, True)):
        held.update(GripperReading(0.04, grasped, "", 0.0), 0.0, z)
    assert held.carried == carried


@pytest.mark.parametrize("reports", [True, False])  # else from differences
@pytest.mark.parametrize(
    ("speed", "coasts", "rests"),
    [(0.0099, np.inf, True), (0.0101, np.inf, False), (1.0, 2.95, True), (1.0, 3.05, False)],
)
def test_an_arm_rests_below_a_hundredth_of_a_radian_a_second_within_three_seconds(
    speed: float, coasts: float, rests: bool, reports: bool
) -> None:
    cell = with_arm(speed=speed, coasts=coasts, reports=reports)
    loop = ControlLoop(cell.connection(), SAFETY, True, **QUIET)
    assert np.isfinite(loop.stop("", "").rest_seconds) == rests


@pytest.mark.parametrize(("reads", "rests"), [(9, True), (10, False)])
def test_a_clock_that_stands_still_is_watched_for_ten_seconds_of_wall_time(
    reads: int, rests: bool, monkeypatch: Patch
) -> None:
    """A second of wall time passes at each look."""
    cell, wall = FakeCell(), iter(range(99))
    loop = ControlLoop(cell.connection(), SAFETY, True, **QUIET)
    readings = (replace(cell.arm.reading, velocity=(n < reads) * E[0], time=1.0 * n) for n in wall)
    monkeypatch.setattr(cell.arm, "read", lambda: next(readings))
    monkeypatch.setattr(cell.clock, "wait", lambda _: None)
    ticking = iter(range(99))
    monkeypatch.setattr(control_loop, "time", SimpleNamespace(monotonic=lambda: next(ticking)))
    assert np.isfinite(loop.stop("", "").rest_seconds) == rests


@pytest.mark.parametrize(
    ("pace", "tick", "slow"),
    [(0.96, 40, False), (0.94, 40, True), (0.5, 18, False), (0.5, 23, True)],  # in the first second
)
def test_a_twin_below_95_percent_of_real_time_is_named(pace: float, tick: int, slow: bool) -> None:
    cell = with_arm(pace=pace)
    pressed = replace(cell.arm.reading, wrench=20.0 * np.eye(6)[2])
    ending = cell.run(lambda now: setattr(cell.arm, "reading", pressed) if now == tick else None)
    assert "force 20" in ending.reason and ("cannot keep up" in ending.advice) == slow


class Paced(FakeCamera):
    """A camera that takes `rate` pictures a second."""

    def read(self) -> Frame:
        return Frame(self.image, round(self.rate * self.clock.time), self.clock.time)


@pytest.mark.parametrize(
    ("what", "inside", "outside", "says"),
    [
        ("velocity", 0.049, 0.051, "it moves"),
        ("wrench", 7.49, 7.51, "at rest"),
        ("late", 0.25, 0.26, "0.26 s old"),
        ("rate", 24.0, 23.0, "23.0 pictures a second instead of 30"),
        ("counts", 11.9, 12.1, "looks touched (12 counts)"),
        ("disk", 801e6, 799e6, "make room for 0.8 GB"),  # 500 MB, and 10 MB for each of 30 s
    ],
)
def test_what_preflight_lets_pass(
    what: str, inside: float, outside: float, says: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    tips = 'fingertips = { sensor = "gelsight_mini", left = "http://l", right = "http://r" }\n'
    config = read_cell_file(write_cell_file(tmp_path, SIM + tips))
    monkeypatch.setattr(preflight, "require_readable", lambda *_: None)
    picture = load(GELSIGHT_MINI.sensor_file).background
    for value, refused in ((inside, False), (outside, True)):
        given = {"rate": 30.0, "late": 0.0, "counts": 0.0, "disk": 1e12} | {what: value}
        cell = with_arm(late=given["late"])
        if what in ("velocity", "wrench"):
            old = getattr(cell.arm.reading, what)
            cell.arm.reading = replace(cell.arm.reading, **{what: value * np.eye(len(old))[2]})
        cell.cameras = {ft.FRONT: Paced(cell.clock, picture, given["rate"])}
        for key in ft.TACTILE:
            tip = FakeCamera(cell.clock, picture)
            cell.cameras[key] = TactileCamera(tip, GELSIGHT_MINI, NO_CROP)
        strength = np.array([given["counts"]])
        monkeypatch.setattr(preflight, "contact_strength", lambda *_, found=strength: found)
        monkeypatch.setattr(
            shutil, "disk_usage", lambda _, n=given["disk"]: SimpleNamespace(free=n)
        )
        lines = preflight.preflight(config, cell.connection(), SAFETY, tmp_path, lambda: 0)
        remedies = "; ".join(line.remedy for line in lines if not line.ok)
        assert (says in remedies) == refused == bool(remedies)


def deployed(cell: FakeCell, off: float, folder: Path, **parts: object) -> session.Result:
    """A run that begins with a move to a start pose `off` (rad), and whose plan is over at once."""
    start = (HOME + off * E[0]).tolist()
    file = write_cell_file(folder, SIM.replace("seed = 3", f"start = {start}"))
    connection = replace(cell.connection(), **parts)
    nothing = lambda loop: ScriptedActor([], loop.commanded, 20)  # noqa: E731
    parts = [read_cell_file(file), connection, SAFETY, lambda *_: 0, True, nothing]
    return session.Session(*parts, **QUIET).run()


@pytest.mark.parametrize(("off", "moves"), [(0.099, False), (0.101, True)])
def test_a_start_pose_near_by_is_not_moved_to(off: float, moves: bool, tmp_path: Path) -> None:
    cell = FakeCell()
    deployed(cell, off, tmp_path)
    assert np.abs(cell.arm.reading.q - HOME - off * moves * E[0]).max() < 1e-3


@pytest.mark.parametrize(("missed", "stops"), [(0.0199, False), (0.0201, True)])
def test_a_start_pose_is_met_within_two_hundredths_of_a_radian(
    missed: float, stops: bool, tmp_path: Path, monkeypatch: Patch
) -> None:
    move, off = scripted.start_move, missed * E[0]
    monkeypatch.setattr(session, "start_move", lambda goal, *rest: move(goal - off, *rest))
    ending = deployed(FakeCell(), 0.3, tmp_path).ending
    assert ending.stopped == stops == ("missed by 0.020" in ending.reason)


def test_a_start_move_that_waits_for_the_arm_ends_after_a_minute(tmp_path: Path) -> None:
    assert deployed(with_arm(lag=0.15), 0.3, tmp_path).ending.reason == "time is up (60 s)"


@pytest.mark.parametrize(("settles", "success"), [(1.9, True), (2.1, False)])
def test_a_simulator_has_two_seconds_to_see_success(
    settles: float, success: bool, tmp_path: Path
) -> None:
    cell = FakeCell()
    truth = lambda: {"success": cell.clock.time - 1e-6 > settles, "progress": 0.0}  # noqa: E731
    with_truth = replace(cell.connection(), truth=truth)
    config = read_cell_file(write_cell_file(tmp_path, SIM))
    parts = [config, with_truth, SAFETY, lambda *_: 0, True, lambda _: None]
    run = session.Session(*parts, **QUIET)
    assert run._success(session.Ending("over")) is success


@pytest.mark.parametrize(
    ("kind", "lag", "off", "creep", "press", "done"),
    [  # rad behind the command, rad that the command is off the path, m a tick of the hand, N
        ("path", 0.119, 0.0, 0.0, 0.0, True),
        ("path", 0.121, 0.0, 0.0, 0.0, False),
        ("path", 0.0, 0.0199, 0.0, 0.0, True),
        ("path", 0.0, 0.0201, 0.0, 0.0, False),
        ("wait", 0.0199, 0.0, 0.0, 0.0, True),
        ("wait", 0.0201, 0.0, 0.0, 0.0, False),
        ("wait", 0.0, 0.0, 0.49e-3, 0.0, True),
        ("wait", 0.0, 0.0, 0.51e-3, 0.0, False),
        ("probe", 0.121, 0.0, 0.0, 2.49, False),
        ("probe", 0.121, 0.0, 0.0, 2.51, True),
    ],
)
def test_a_plan_goes_on_while_arm_and_hand_follow(
    kind: str, lag: float, off: float, creep: float, press: float, done: bool
) -> None:
    path = joint_move(HOME, HOME + 1e-4 * E[0], SAFETY.joints)
    move = PlannedMove(path, 0.0, 0.2, kind == "probe")
    move = PlannedMove(None, 0.0, 0.2) if kind == "wait" else move
    q = HOME + off * E[0]
    actor = ScriptedActor([move], lambda: q, 20)
    for tick in range(12):
        state = np.concatenate([q - lag * E[0], np.zeros(7), [0.04 + creep * tick]])
        actor.act({ft.STATE: state, ft.WRENCH: press * (tick > 0) * np.eye(6)[2]})
    assert actor.done == done


def walked(actor: ScriptedActor, q: np.ndarray) -> np.ndarray:
    """Return the joints (rad) of each tick of an arm that follows at once."""
    path = [q]
    while not actor.done:
        state = np.concatenate([path[-1], np.zeros(7), [0.04]])
        path.append(path[-1] + actor.act({ft.STATE: state, ft.WRENCH: np.zeros(6)})[:7])
        actor._commanded = lambda: path[-1]
    return np.array(path)


def test_what_pick_and_place_plans() -> None:
    """Heights, waits and speeds of the plan; the start move is a third as fast."""
    planned = []
    for height in (
        0.05,
        0.0,
    ):  # the box's floor is 5.6 mm up, the fingers reach 16.5 mm below the TCP
        place = PickPlacePoses((0.45, 0.0, height, 0.0), (0.5, 0.1))
        actor = scripted.pick_and_place(place, SAFETY, lambda: HOME)
        planned += actor._actions.gi_frame.f_locals["moves"]
    ends = [m.path and KINEMATICS.forward(m.path.at(m.path.duration))[0][2] for m in planned]
    high = [0.17, 0.05, None, 0.17, 0.17, 0.054, 0.046, None]
    low = [0.1441, 0.0241, None, 0.1441, 0.1441, 0.0281, 0.0228, None]
    assert ends == [z and pytest.approx(z, abs=1e-6) for z in high + low]
    assert [m.width for m in planned[:8]] == [0.08, 0.08, *[0.0] * 6]
    assert [planned[i].seconds for i in (2, 6, 7)] == [1.0, 3.0, 0.8]
    paths = [m.path.sample(1000) for m in planned if m.path]
    fastest = max((np.abs(np.diff(q, axis=0)) * 1000 / FR3.policy.velocity).max() for q in paths)
    assert 0.85 < fastest <= 0.9


def test_the_start_move_goes_at_a_third_of_a_policys_speed() -> None:
    path = walked(scripted.start_move(HOME + 0.6 * E[0], 0.04, SAFETY, lambda: HOME), HOME)
    assert 0.29 < np.abs(np.diff(path, axis=0)).max() * 20 / (0.2 * 2.62) <= 0.3


def test_the_follower_goes_along_the_wire_and_yields_across_it() -> None:
    """25 mm/s, 2 mm/s for each newton, a quarter of a second of memory, at most 6 mm ahead."""
    actor, command, tcp = WireFollower(20), HOME.copy(), KINEMATICS.forward(HOME)

    def step(measured: np.ndarray, force: float) -> np.ndarray:
        nonlocal command
        state = np.concatenate([measured, np.zeros(7), [0.0]])
        action = actor.act({ft.STATE: state, ft.WRENCH: force * across})
        command = command + action[:7]
        return tcp[1].T @ (KINEMATICS.forward(command)[0] - tcp[0])

    across = np.concatenate([tcp[1][:, 1], np.zeros(3)])
    assert not any(step(HOME, 0.0).any() for _ in range(10)), "the hand closes for half a second"
    assert step(HOME, 10.0) == pytest.approx([1.25e-3, 1e-3, 0.0], abs=5e-6)
    ahead = [np.linalg.norm(step(HOME, 0.0)) for _ in range(8)]
    assert ahead[-1] == pytest.approx(6e-3, abs=1e-5)
    moved = HOME + KINEMATICS.joint_change(HOME, np.concatenate([2e-3 * across[:3], np.zeros(3)]))
    speed = actor._velocity @ tcp[1]
    step(moved, 0.0)
    assert actor._velocity @ tcp[1] == pytest.approx(0.8 * speed + 0.2 * 0.04 * E[1, :3], abs=5e-5)


@pytest.mark.parametrize(("change", "moves"), [(0.9e-3, False), (1.1e-3, True)])
def test_the_arm_is_moved_by_hand_beyond_a_thousandth(
    change: float, moves: bool, tmp_path: Path
) -> None:
    cell = FakeCell()
    config = read_cell_file(write_cell_file(tmp_path, SIM))
    manual = ManualControl(config, cell.connection(), **QUIET)
    manual.move_arm(HOME + change * E[0])
    assert (cell.arm.reading.q[0] > HOME[0]) == moves
    cell.clock.time = 0.0
    manual.move_hand(opened=True)
    assert 1.0 <= cell.clock.time < 1.15, "a second of standing still"


def test_how_long_a_plan_is_waited_for(monkeypatch: Patch) -> None:
    """20 s for the first, half a tick for the others, 2 s at the end."""
    horizons = SimpleNamespace(observation_horizon=1, execution_horizon=1, control_hz=20)
    plan = lambda _: time.sleep(1e-3) or np.zeros((2, 8), np.float32)  # noqa: E731
    planner = SimpleNamespace(config=horizons, history_ticks=1, plan=plan, embed=lambda _: None)
    actor, waits = RealTimeActor(planner), []
    wait = actor._condition.wait_for

    def noted(holds: Callable, timeout: float | None = None) -> bool:
        waits.append(timeout)
        return wait(holds, timeout)

    monkeypatch.setattr(actor._condition, "wait_for", noted)
    for _ in range(3):
        actor.act({})
    join = actor._thread.join
    monkeypatch.setattr(actor._thread, "join", lambda seconds: waits.append(seconds) or join(5))
    actor.close()
    assert set(waits) == {None, 20.0, 0.025, 2.0}
    late = RealTimeActor(planner)
    monkeypatch.setattr(late._condition, "wait_for", lambda *_: False)
    with pytest.raises(UserError, match="no plan in 20 s"):
        late.start({})
    late.close()

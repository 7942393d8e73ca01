"""Whatever a device raises, and whenever: a run ends with an ending, an advice and its ticks."""

import threading
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from fake_cell import (
    SIM,
    FakeCamera,
    FakeCell,
    FakeClock,
    FakeFingertip,
    FakeLoadCell,
    KeptTicks,
    write_cell_file,
)

from touchgoal.control import features as ft
from touchgoal.control.cell import connection
from touchgoal.control.cell.cell_file import find_cell_file, read_cell_file
from touchgoal.control.deployment.control_loop import Request
from touchgoal.control.deployment.hand import HandMonitor
from touchgoal.control.deployment.preflight import preflight
from touchgoal.control.deployment.session import Session
from touchgoal.control.interfaces import Actor, CostReading, DriverError, GripperReading
from touchgoal.control.run_log import RunLog
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.episodes.episode_recorder import EpisodeRecorder
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError

ERRORS = (DriverError, OSError, ValueError, TimeoutError)
IN_A_TICK = {  # methods that are called in every tick; without "stop", "close" and "problem"
    *("arm.read", "arm.command", "gripper.read", "gripper.command", "front.read"),
    *("tactile_left.read", "load_cell.read", "actor.act"),
}
METHODS = sorted(IN_A_TICK) + ["arm.stop", "arm.close", "gripper.stop", "gripper.close"]
METHODS += ["front.problem", "front.close", "tactile_left.problem", "load_cell.close"]
METHODS += ["actor.start", "actor.close"]
TIPS = 'fingertips = { sensor = "gelsight_mini", left = "simulated", right = "simulated" }'
BEGINS = 10  # tick at which a fault begins, or the operator stops the run


class Faulty:
    """A device one of whose methods raises while `broken` says so."""

    def __init__(self, device: Any, method: str, error: Exception, broken: Callable[[], bool]):
        self._device, self._method, self._error, self._broken = device, method, error, broken

    def __getattr__(self, name: str) -> Any:
        if name != self._method:
            return getattr(self._device, name)
        if name == "problem":
            self._check()
            return ""
        return self._call

    def _check(self) -> None:
        if self._broken():
            raise self._error

    def _call(self, *given: Any) -> Any:
        self._check()
        return getattr(self._device, self._method)(*given)


class Turns(Actor):
    """Turns the first joint for 15 ticks."""

    ticks = 0

    def act(self, observation: dict) -> np.ndarray:
        self.ticks += 1
        self.done = self.ticks > 15
        return np.array([0.001, *[0.0] * 6, 0.04])


@pytest.mark.parametrize("stage", ["start", "tick", "stop"])
@pytest.mark.parametrize("where", METHODS)
@pytest.mark.parametrize("error", [kind("it broke") for kind in ERRORS], ids=repr)
def test_whatever_a_device_raises_a_run_ends_in_good_order(
    error: Exception, where: str, stage: str, tmp_path: Path
) -> None:
    name, _, method = where.partition(".")
    cell, recorder, actor = FakeCell(), KeptTicks(), Turns()
    begins = BEGINS if stage != "start" else int(method == "problem")  # which type checks read

    def wrapped(device: Any) -> Any:
        return Faulty(device, method, error, lambda: actor.ticks >= begins)

    cell.load_cell = FakeLoadCell(cell.clock)
    cell.cameras[ft.FRONT] = FakeCamera(cell.clock, np.zeros(ft.CAMERA_SHAPE, np.uint8))
    if name == "tactile_left":
        cell.cameras[ft.TACTILE_LEFT] = FakeFingertip(cell.clock)
    arm, cameras = cell.arm, cell.cameras
    if name in ("arm", "gripper", "load_cell"):
        setattr(cell, name, wrapped(getattr(cell, name)))
    elif name == "actor":
        faulty = wrapped(SimpleNamespace(**{method: getattr(actor, method)}))
        setattr(actor, method, getattr(faulty, method))
    else:
        cameras[ft.IMAGE_PREFIX + name] = wrapped(cameras[ft.IMAGE_PREFIX + name])
    config = read_cell_file(write_cell_file(tmp_path, SIM))
    connection, safety = cell.connection(), ActionFilter(FR3, ft.CONTROL_HZ)

    def request() -> Request:
        return "stop" if stage == "stop" and actor.ticks >= BEGINS else ""

    session = Session(
        config, connection, safety, recorder, True, lambda _: actor, request, lambda _: None
    )
    try:
        result = session.run()
    except UserError as refused:  # it did not begin, and nothing has moved
        assert stage == "start" and "it broke" in str(refused) and not recorder
        return
    finally:
        connection.close()
    ending = result.ending
    fault = where in IN_A_TICK and stage != "stop" or (stage, where) == ("start", "actor.start")
    assert ending.stopped == (fault or stage == "stop")
    assert "it broke" in ending.reason or not fault
    assert len(recorder) == result.log.ticks >= (0 if stage == "start" else BEGINS - 1)
    assert (result.episode == 0) == bool(recorder)
    if ending.stopped:
        assert ending.advice and arm.stopped == (where != "arm.stop")
        assert ("emergency stop" in ending.advice) == (where == "arm.stop")
        assert np.isfinite(ending.rest_seconds) == (where != "arm.read")


@pytest.mark.parametrize("kind", ERRORS)
def test_what_was_opened_is_closed_if_a_device_does_not_open(
    kind: type[Exception], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    closed: list[str] = []

    def opens(name: str) -> Any:  # the front camera does not close
        return SimpleNamespace(close=lambda: closed.append(name) or 1 / (name != "front"))

    monkeypatch.setattr(connection, "connect_camera", lambda _, key: opens(key.split(".")[-1]))
    monkeypatch.setattr(connection, "_gripper", lambda _: opens("gripper"))
    monkeypatch.setattr(connection, "connect_arm", MagicMock(side_effect=kind("it broke")))
    cell = replace(read_cell_file(find_cell_file(Path("fr3_two_minis"))), load_cell=None)
    with pytest.raises(UserError, match="^arm: .*it broke$"):
        connection.connect_cell(cell)
    assert closed == ["gripper", "tactile_right", "tactile_left", "front"]
    assert "did not close: division by zero" in capsys.readouterr().err


class NewImages(FakeCamera):
    def read(self) -> Any:
        self.image = self.image.copy()
        return super().read()


@pytest.mark.parametrize("recorded", [False, True])
def test_memory_does_not_grow_with_a_pause_or_a_run(recorded: bool, tmp_path: Path) -> None:
    """The images of 400 ticks take 20 MB."""
    cell, sizes = FakeCell(), {}
    cell.cameras[ft.FRONT] = NewImages(cell.clock, np.zeros(ft.CAMERA_SHAPE, np.uint8))
    recorder = EpisodeRecorder(tmp_path / "episodes", ft.CONTROL_HZ)
    log = RunLog(recorder.add) if recorded else RunLog()

    def each(tick: int) -> None:
        while recorder._queue.qsize() > 50:  # this clock is faster than the disk
            time.sleep(1e-3)
        if tick % 400 == 0:
            sizes[tick // 400] = tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        cell.run(each, seconds=42.0, log=log)
        assert (sizes[2] - sizes[1]) < 6e6  # what waits for the disk at either moment
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        if recorded:
            recorder.save("turn", {"success": True})
            assert tracemalloc.get_traced_memory()[1] - before < 6e6
            read = EpisodeSet(tmp_path / "episodes").read(0, [ft.STATE])
            assert len(read) == log.ticks > 800
    finally:
        tracemalloc.stop()
        recorder.close()
    assert [path.name for path in tmp_path.iterdir()] == (["episodes"] if recorded else [])


@pytest.mark.parametrize("reason", ["File exists", "slower than the recording"])
def test_a_failed_disk_stops_nothing_and_is_said_when_the_episode_is_saved(
    reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    go_on = threading.Event()
    if reason != "File exists":
        monkeypatch.setattr(EpisodeRecorder, "_write_tick", lambda *_: go_on.wait())
    recorder = EpisodeRecorder(tmp_path / "file" / "set", ft.CONTROL_HZ)
    for _ in range(150):
        recorder.add({ft.STATE: np.zeros(15, np.float32)})
        time.sleep(0 if go_on.is_set() else 1e-4)
    go_on.set()
    with pytest.raises(UserError, match=reason):
        recorder.save("turn", {})
    recorder.close()


class SlowToWarmUp:
    """A cost whose first measurement takes 1.5 s."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock, self.log = clock, []

    def begin(self, observation: dict) -> None:
        self.log.append("begin")

    def hand_over(self, observation: dict) -> None:
        self.log.append("tick")

    def read(self) -> CostReading:
        if "read" not in self.log:
            self.clock.wait(self.clock.now() + 1.5)
        self.log.append("read")
        return CostReading(0.5, self.clock.now())

    judge = read


def test_a_cost_warms_up_before_the_first_tick() -> None:
    cell = FakeCell()
    cost = SlowToWarmUp(cell.clock)
    ending = cell.run(lambda _: None, seconds=1.0, cost=cost)
    assert not ending.stopped and cost.log[:4] == ["begin", "read", "tick", "read"]
    assert [row[ft.COST].item() for row in cell.rows] == [0.5] * len(cell.rows)
    assert max(cell.log.lateness) == 0


def test_the_hands_time_counts_from_the_command() -> None:
    monitor, open_hand = HandMonitor(FR3.tool), GripperReading(0.08, False, "", 0.0)
    assert not monitor.update(open_hand, 0.08, 0.0, None, 0.0)
    # It is to close now, and that was sent only 1.5 s later.
    assert not monitor.update(open_hand, 0.0, 1.5, None, 1.55)
    assert "for 1.4 s" in monitor.update(open_hand, 0.0, 2.85, None, 2.9)


def test_a_hand_that_already_holds_something_is_to_be_opened_first(tmp_path: Path) -> None:
    cell = FakeCell()
    cell.gripper.reading = GripperReading(0.04, True, "", 0.0)
    assert not cell.run(lambda _: None, seconds=2.0).stopped  # without fingertips
    cell.cameras[ft.TACTILE_LEFT] = FakeFingertip(cell.clock)
    with pytest.raises(UserError, match="holds something, 40 mm wide.*open the hand first"):
        cell.run(lambda _: None)
    assert not cell.arm.stopped
    config = read_cell_file(write_cell_file(tmp_path, SIM + TIPS))
    safety = ActionFilter(FR3, ft.CONTROL_HZ)
    checks = preflight(config, replace(cell.connection(), cameras={}), safety, tmp_path, lambda: 0)
    assert ["open the hand first" in str(c) for c in checks] == [
        c.name == "gripper" for c in checks
    ]


def test_an_actor_cannot_change_what_is_recorded() -> None:
    cell = FakeCell()
    cell.cameras[ft.FRONT] = FakeCamera(cell.clock, np.full(ft.CAMERA_SHAPE, 7, np.uint8))
    for key in (ft.STATE, ft.FRONT):

        class Edits(Turns):
            def act(self, observation: dict, key: str = key) -> np.ndarray:
                action = super().act(observation)
                if self.ticks > 5:
                    observation[key] -= 1
                return action

        ending = cell.run(lambda _: None, actor=Edits())
        assert "read-only (test_device_faults.py line" in ending.reason and len(cell.rows) == 5
        assert cell.cameras[ft.FRONT].image.min() == 7

"""The control loop: read, act, filter, command and record once a control tick.

It ends in good order whatever happens: the arm is stopped and watched until it is at rest, and the
recorded ticks are returned. A dry run reads and plans as if the arm followed, and commands nothing.
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from traceback import extract_tb
from typing import Literal

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control import interfaces
from touchgoal.control.arms.driver_process import error_line
from touchgoal.control.cell.connection import CellConnection, RealClock
from touchgoal.control.deployment.hand import HandMonitor, HeldObject, require_empty_hand
from touchgoal.control.deployment.observation import CellReading, ObservationReader
from touchgoal.control.features import read_only
from touchgoal.control.run_log import SLOW_ARM, RunLog, slow_arm
from touchgoal.control.safety.action_filter import ActionFilter, Limit, Measurements, SafetyState
from touchgoal.runtime.errors import UserError

_REST_SPEED = 0.01  # rad/s
_REST_TIMEOUT = 3.0  # s to wait for rest, by the loop's clock
_REST_WALL_TIMEOUT = 10.0  # s of wall time to wait for rest

ADVICE = {
    Limit.NOT_A_NUMBER: "the policy's output is broken: do not use this checkpoint",
    Limit.STALE_OBSERVATION: "a camera or fingertip is late: check its cable and the machine's load",
    Limit.STALE_ACTION: "the policy is too slow or hangs: make it smaller, or free the machine",
    Limit.STALE_STATE: "the arm's state is late or broken: check the network to the controller",
    Limit.STALE_GRIPPER: "the gripper's state is late or broken: check its cable and supply",
    Limit.FORCE: "something pressed on the hand: clear it, then start again; a task that presses harder "
    "by itself needs a higher safety.force in the cell file; an FR3 itself stops at 30",
    Limit.TORQUE: "something pressed on the arm: clear it, then start again",
    Limit.LOAD: "something pressed on the table: clear it, then start again",
    Limit.INDENTATION: "a gel was pressed too deep: look at it, lower gripper.force; the hand let go, unless "
    "it was carrying something",
    Limit.TRACKING: "the arm does not follow: look for what blocks it",
}
_HAND_ADVICE = (
    "look at the hand: clear its fingers, check its cable and supply, home it (a Franka's in Desk)"
)


@contextmanager
def _realtime_priority() -> Iterator[None]:
    """Run this thread before all that is not real-time, where that is allowed."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except PermissionError:  # as on most machines; the loop then reports how late it was
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    reason: str  # what happened, for a person
    done: bool | None = None  # whether the task is done, as far as this ending tells; None: unknown
    stopped: bool = False  # whether the arm was stopped, by a fault or a person
    advice: str = ""  # what to do about it
    rest_seconds: float = 0.0  # s from the decision to stop to rest; infinite if it never was

    def __str__(self) -> str:
        if not self.stopped:
            return self.reason
        rests = np.isfinite(self.rest_seconds)
        rest = f"at rest after {self.rest_seconds:.2f} s" if rests else "NOT known to be at rest"
        return f"STOPPED: {self.reason}\n  the arm: {rest}\n  what to do: {self.advice}"


Request = Literal["", "stop", "done", "not done", "discard", "success"]
"""Operator's request: go on, stop the arm, end with the task done or not, or without a record;
success: a simulator's; failed: the cost's."""
PLAN_ENDED, TIME_UP = "the policy is done", "time is up"
JUDGED = "the judge says that the task is done"
STOPPED_BY_OPERATOR, DISCARDED = "stopped by the operator", "discarded by the operator"
_REQUESTED_ENDINGS: dict[Request, Ending] = {
    "done": Ending("the operator says that the task is done", done=True),
    "not done": Ending("the operator says that the task is not done", done=False),
    "discard": Ending(DISCARDED),
    "success": Ending("the simulator says that the task is done", done=True),
}


@dataclass(frozen=True)
class TickStatus:
    """One tick, for the display; `cost` is None without a goal."""

    seconds: float
    state: SafetyState
    reading: CellReading
    width: float
    late: float
    cost: interfaces.CostReading | None


class ControlLoop:
    """One connection under a safety layer, in `state`, and a gripper commanded to `width` (m)."""

    def __init__(
        self,
        connection: CellConnection,
        safety: ActionFilter,
        execute: bool,
        operator_request: Callable[[], Request],
        on_tick: Callable[[TickStatus], None],
        cost: interfaces.Cost | None = None,
        camera_size: tuple[int, int] = ft.CAMERA_SHAPE[:2],
    ) -> None:
        """Begin with the arm at rest.

        UserError outside its limits, for too small images, or if fingertips already hold something.

        Args:
            connection, safety: devices to read and command; their limits and the control rate.
            execute: False: a dry run.
            operator_request, on_tick: called every tick: to stop or end the run, and to show it;
                must not wait.
            cost: measures how far a tick is from its goal, for the display and the record.
            camera_size: rows and columns of the camera images observed and recorded.
        """
        self._connection, self._safety, self._execute = connection, safety, execute
        self._operator_request, self._on_tick, self._cost = operator_request, on_tick, cost
        try:
            self.reader = ObservationReader(connection, camera_size)
            self.state = safety.start(connection.arm.read().q)
            gripper = connection.gripper.read()
        except UserError:
            raise
        except Exception as error:  # of any driver; nothing has moved
            raise interfaces.DriverError(error_line(error)) from error
        if self.reader.has_fingertips:
            require_empty_hand(gripper)
        self.width = gripper.width
        self._held = HeldObject()
        self._hand = HandMonitor(safety.limits.tool)

    def commanded(self) -> np.ndarray:
        """Joint positions (rad) commanded now."""
        return self.state.q

    def run(self, actor: interfaces.Actor, seconds: float, log: RunLog, new: bool = True) -> Ending:
        """Run the actor until it is done, time is up, a person or judge ends it or a fault stops it.

        Without `new` it goes on with the run before.
        """
        try:
            real = isinstance(self._connection.clock, RealClock)
            with _realtime_priority() if real else nullcontext():
                return self._loop(actor, seconds, log, new)
        except UserError as error:
            return self._arm_first(self.stop(str(error), "check what it names, then start again"))
        except (Exception, SystemExit) as error:  # most likely the policy's; stop in any case
            message, origin = " ".join(str(error).split()), extract_tb(error.__traceback__)[-1]
            where = f"{Path(origin.filename).name} line {origin.lineno}"
            return self.stop(
                f"{type(error).__name__}: {message} ({where})", "the program or the policy failed"
            )
        finally:
            _done(actor.close)

    def _loop(self, actor: interfaces.Actor, seconds: float, log: RunLog, new: bool) -> Ending:
        clock = self._connection.clock
        observation = read_only(self._read().observation)
        if self._cost and new:
            self._cost.begin(observation)
        actor.start(observation)
        if self._cost:
            self._cost.read()  # waits for the first, so that no tick does
        begin = due = self._sent_at = clock.now()
        first = True
        while True:
            late = clock.now() - due
            ending = self._tick(actor, log, clock.now() - begin, late)
            if ending is None and actor.given_up:
                ending = Ending(actor.given_up, done=False)
            if ending is None and actor.done:
                ending = Ending(PLAN_ENDED)
            if ending is None and clock.now() - begin > seconds:
                ending = Ending(f"{TIME_UP} ({seconds:.0f} s)", done=False)
            if ending is not None:
                return ending
            if not first:
                log.lateness.append(late)
            # Missed ticks are not made up for.
            dt, now = self._safety.dt, clock.now()
            due = now + dt if first else max(due + dt, now - dt)
            first = False
            clock.wait(due)

    def stop(self, reason: str, advice: str, release_to: float | None = None) -> Ending:
        """Stop arm and gripper for good, and watch the arm come to rest; no device makes it raise.

        `reason` and `advice` are for the operator. The gripper opens to `release_to` (m); None: it
        stays, and holds its object.
        """
        if not self._execute:
            return Ending(reason, False, True, advice)
        arm, clock = self._connection.arm, self._connection.clock
        began, end = clock.now(), time.monotonic() + _REST_WALL_TIMEOUT
        told = _done(arm.stop)
        _done(partial(self._connection.gripper.stop, release_to))
        rest, last = np.inf, None
        while rest == np.inf and clock.now() - began < _REST_TIMEOUT and time.monotonic() < end:
            told = told or _done(arm.stop)
            with suppress(Exception):  # an arm that cannot be read now may be read later
                clock.wait(clock.now() + self._safety.dt / 5)
                reading = arm.read()
                if last and reading.time > last.time and _speed(last, reading) < _REST_SPEED:
                    rest = clock.now() - began
                last = reading
        if not told:
            advice = f"the arm did not take the stop: press the emergency stop; then {advice}"
        return Ending(reason, False, True, advice, rest)

    def _arm_first(self, ending: Ending) -> Ending:
        """Name the arm's own fault first, if it has one: it often makes other devices fail, too."""
        fault = ""
        with suppress(Exception):
            fault = self._connection.arm.read().fault
        if not fault or fault.startswith(interfaces.STOPPED_ON_REQUEST) or fault in ending.reason:
            return ending
        return replace(ending, reason=f"arm: {fault}; also: {ending.reason}")

    def _tick(
        self, actor: interfaces.Actor, log: RunLog, seconds: float, late: float
    ) -> Ending | None:
        reading = self._read()
        log.clocks.extend((self._connection.clock.now(), reading.arm.time))
        if not self._execute:
            reading = self._as_commanded(reading)
        if ending := self._device_fault(reading, actor.recovers):
            return ending
        if request := self._operator_request():
            if request == "stop":
                return self.stop(STOPPED_BY_OPERATOR, "start deploy again when you are ready")
            return _REQUESTED_ENDINGS[request]
        asked = time.perf_counter()
        observation = read_only(reading.observation)
        action = np.asarray(actor.act(observation), np.float64)
        log.answer_times.append(time.perf_counter() - asked)
        before, measured = self.state, self._measurements(reading, actor.action_age)
        self.state = self._safety.filter_action(before, action[:-1], measured)
        self.width = self._safety.filter_width(self.state, float(action[-1]), self.width)
        for limit in self.state.active_limits:
            log.limit_counts[limit] = log.limit_counts.get(limit, 0) + 1
        cost = None
        if self._cost:
            self._cost.hand_over(observation)
            cost = self._cost.read()
        self._on_tick(TickStatus(seconds, self.state, reading, self.width, late, cost))
        if self.state.fault is not None:
            return self._stop_for_fault(reading, log.arm_pace)
        if self._execute:
            self._connection.arm.command(self.state.q)
            self._connection.gripper.command(self.width)
            self._sent_at = self._connection.clock.now()
        done = np.append(self.state.q - before.q, self.width).astype(np.float32)
        tick = {**observation, ft.ACTION: done}
        if cost is not None:
            tick[ft.COST] = np.array([cost.cost], np.float32)
        log.add(tick)
        return Ending(JUDGED, done=True) if cost is not None and cost.done else None

    def _device_fault(self, reading: CellReading, recovers: bool) -> Ending | None:
        """Stop for a device that reports a fault, for a lost object or a hand that does not follow.

        An actor that `recovers` goes on without the object.
        """
        if reading.fault:
            return self.stop(reading.fault, "see above; then start deploy again")
        self._held.update(reading.gripper, self.width, float(reading.observation[ft.TCP_POSE][2]))
        if self._held.lost and recovers:
            self._held = HeldObject()
        elif self._held.lost:
            return self.stop("the hand has lost its object", "put it back, then start again")
        if not self._execute:
            return None
        indentation = reading.indentation if self.reader.has_fingertips else None
        now = self._connection.clock.now()
        sent = self.width, self._sent_at
        if wrong := self._hand.update(reading.gripper, *sent, indentation, now):
            return self.stop(wrong, _HAND_ADVICE)
        return None

    def _measurements(self, reading: CellReading, action_age: float) -> Measurements:
        age = self._connection.clock.age
        return Measurements(
            q=reading.arm.q,
            force=reading.arm.wrench[:3],
            torque=reading.arm.torque,
            indentation=reading.indentation,
            observation_age=reading.age,
            action_age=action_age,
            state_age=age(reading.arm.stamp) if self._execute else 0.0,
            gripper_age=age(reading.gripper.stamp),
            load=reading.added_load,
        )

    def _read(self) -> CellReading:
        """Read the devices, with the commanded positions in the observation."""
        reading = self.reader.read()
        command = np.concatenate([self.state.q, self.state.velocity]).astype(np.float32)
        age = max(reading.age, self._connection.clock.age(reading.arm.stamp))
        known = {ft.COMMAND: command, ft.AGE: np.array([age], np.float32)}
        return replace(reading, observation={**reading.observation, **known})

    def _stop_for_fault(self, reading: CellReading, arm_pace: float) -> Ending:
        fault = self.state.fault
        assert fault is not None
        reason = str(fault)
        if fault.limit == Limit.STALE_OBSERVATION:
            reason += f" s ({reading.oldest_source}; {self.reader.problem() or 'it is slow'})"
        elif self.reader.unsound and fault.limit in (Limit.STALE_STATE, Limit.STALE_GRIPPER):
            reason += f" s ({self.reader.unsound})"
        release_to = None
        if fault.limit == Limit.INDENTATION and not self._held.carried:
            # Open by the ceiling of both gels, unless an object is carried: it would fall.
            width = reading.gripper.width + 2 * self._safety.limits.indentation
            release_to = min(width, self._safety.limits.tool.stroke[1])
        advice = ADVICE.get(fault.limit, "look at what it names")
        if fault.limit == Limit.FORCE and np.isnan(fault.value):
            advice = (
                "the arm is near a singularity, where it measures no forces: keep the task away"
            )
        if arm_pace < SLOW_ARM:
            advice = slow_arm(arm_pace)
        return self.stop(reason, advice, release_to)

    def _as_commanded(self, reading: CellReading) -> CellReading:
        """Return the reading as if arm and hand had followed through free air; real forces still stop."""
        arm = replace(reading.arm, q=self.state.q, velocity=self.state.velocity)
        gripper = replace(reading.gripper, width=self.width)
        imagined = self.reader.proprioception(replace(arm, wrench=np.zeros(6)), gripper)
        return replace(reading, arm=arm, observation={**reading.observation, **imagined})


def _done(call: Callable[[], None]) -> bool:
    """Return whether a call to a device went through; no fault may keep the rest of a stop undone."""
    with suppress(Exception):
        call()
        return True
    return False


def _speed(before: interfaces.ArmReading, now: interfaces.ArmReading) -> float:
    """Speed of the fastest joint, rad/s; from differences if the arm reports none."""
    if np.isfinite(now.velocity).all():
        return float(np.abs(now.velocity).max())
    return float(np.abs(now.q - before.q).max()) / (now.time - before.time)

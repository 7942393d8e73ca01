"""Franka Hand through franky-control, in a child process.

The hand takes one slow command at a time, while a policy asks for a width every tick. The newest
width is sent when the last command is done, which is after 0.8 s at most; `stop` ends one at once.
So a width that merely passes on the way to another is not sent: one that changes faster than the hand
could follow, unless it goes on doing so. A hand's grasp closes until it meets something, whatever width
it is told, so only closing all the way grasps; any other width is a move, and one that meets something
on its way in grasps that.
"""

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from touchgoal.control.arms.client_libraries import FRANKY
from touchgoal.control.arms.driver_process import NEVER, DriverProcess
from touchgoal.control.errors import UserError
from touchgoal.control.interfaces import DriverError, GripperReading

if TYPE_CHECKING:
    import franky

_STEP = 2e-3  # m between commands that differ, and up to which a width is shut
_SPEED = 0.1  # m/s; the hand's fastest
_STOP_TIMEOUT = 0.5  # s that a stop may take; 0.06 on the twin
_ANSWER_TIMEOUT = 1.0  # s for an answer that a twin has sent to arrive
PERIOD = 0.05  # s between looks at the hand
_MOST_PASSING = 3  # of them for which widths may pass


class FrankaHandClient:
    """In the child: one hand. Its state comes every 20 to 50 ms."""

    def __init__(self, address: str, force: float, lock_step: bool = False) -> None:
        """With `lock_step`, `advance` takes the place of the clock's ticks."""
        self.period = NEVER if lock_step else PERIOD
        self._issued = 0  # commands sent to the hand
        self._answered: int | None = None  # of them, as a twin says
        self._franky, self._force = FRANKY.load("franky"), force
        self._hand = self._franky.Gripper(address)
        self._max_width = self._hand.state.max_width
        if self._max_width <= 0:
            raise UserError("the Franka Hand does not know its stroke: home it in Desk first")
        self._running: franky.BoolFuture | None = None
        self._inwards = False  # whether that is a move that closes
        self._sent = self._target = self._last_target = self._hand.state.width
        self._passing = 0  # ticks for which widths have passed
        self._fault, self._clock = "", -1
        self._stopped = False
        self._reading = self._measure()

    def read(self) -> GripperReading:
        """The state as of the last tick; a fault counts from when it happened."""
        return replace(self._reading, fault=self._fault)

    def command(self, width: float) -> None:
        """A new target (m)."""
        if self._fault or self._stopped:
            raise DriverError(f"no command is taken: {self._fault or 'the hand was stopped'}")
        self._target = min(max(width, 0.0), self._max_width)

    def stop(self, release_to: float | None = None) -> None:
        """End the command that runs and send no other, except to let go (m)."""
        if not self._stopped and self._running is not None and not self._running.wait(0.0):
            self._hand.stop_async().wait(_STOP_TIMEOUT)
        self._stopped, self._running, self._inwards = True, None, False
        self._target = self._sent
        if release_to is not None:
            width = min(max(release_to, 0.0), self._max_width)
            self._running = self._hand.move_async(width, _SPEED)

    def tick(self) -> None:
        """Read the state; send the target if it is news."""
        try:
            self._reading = self._measure()
            if self._fault or self._stopped:
                return
            news = not self._passes() and abs(self._target - self._sent) > _STEP
            if self._idle() and news:
                self._go(self._target)
        except Exception as error:
            self._fault = f"{type(error).__name__}: {' '.join(str(error).split())}"

    def advance(self, answered: int) -> int:
        """Tick, when a twin says that so many commands are answered; how many have been sent."""
        self._answered = answered
        self.tick()
        return self._issued

    def close(self) -> None:
        """See Gripper."""

    def _passes(self) -> bool:
        """Whether the target only passes, faster than the hand could follow; once a tick."""
        changed, self._last_target = abs(self._target - self._last_target), self._target
        passes = self._target > _STEP and changed > _SPEED * PERIOD
        self._passing = self._passing + 1 if passes else 0
        return 0 < self._passing <= _MOST_PASSING

    def _measure(self) -> GripperReading:
        state = self._hand.state
        clock, stamp = state.time.to_msec(), time.monotonic()
        if clock == self._clock:
            stamp = self._reading.stamp
        self._clock = clock
        return GripperReading(state.width, state.is_grasped, self._fault, stamp)

    def _idle(self) -> bool:
        """Whether the last command is done; what it met on its way in is grasped."""
        if self._running is None:
            return True
        arrives = self._answered is not None and self._answered >= self._issued
        if not self._running.wait(_ANSWER_TIMEOUT if arrives else 0.0):
            return False
        arrived, self._running = self._running.get(), None  # raises what went wrong
        if not arrived and self._inwards:
            self._grasp(self._sent)
        return self._running is None

    def _go(self, width: float) -> None:
        self._sent = width
        if self._reading.grasped and width < self._reading.width:
            return  # the grasp goes on: it holds by force
        if width <= _STEP:
            self._grasp(width)
        else:
            self._inwards = width < self._reading.width
            self._issued += 1
            self._running = self._hand.move_async(width, _SPEED)

    def _grasp(self, width: float) -> None:
        # What is met before `width` counts as grasped, whatever its size.
        self._inwards = False
        self._issued += 1
        self._running = self._hand.grasp_async(
            width, _SPEED, self._force, epsilon_inner=width, epsilon_outer=self._max_width
        )


class FrankaHand:
    """The Gripper protocol over a hand; it closes with `force` (N, 30 to 70)."""

    def __init__(self, address: str, force: float = 30.0, lock_step: bool = False) -> None:
        self._process = DriverProcess(FrankaHandClient, address, force, lock_step)

    def read(self) -> GripperReading:
        """See Gripper."""
        return self._process.call("read")

    def command(self, width: float) -> None:
        """See Gripper."""
        self._process.call("command", width)

    def stop(self, release_to: float | None = None) -> None:
        """See Gripper."""
        self._process.call("stop", release_to)

    def advance(self, answered: int) -> int:
        """See FrankaHandClient."""
        return self._process.call("advance", answered)

    def close(self) -> None:
        """See Gripper."""
        self._process.close()

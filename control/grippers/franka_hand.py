"""Franka Hand through franky-control, in a child process; `hand_commands.py` chooses its commands."""

import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from touchgoal.control.arms.client_libraries import FRANKY
from touchgoal.control.arms.driver_process import NEVER, DriverProcess, call_timeout
from touchgoal.control.grippers.hand_commands import PERIOD, SPEED, HandCommands, LastCommand
from touchgoal.control.interfaces import DriverError, Gripper, GripperReading
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.runtime.errors import UserError

if TYPE_CHECKING:
    import franky

_STOP_TIMEOUT = 0.5  # s that a stop may take; 0.06 on the twin
_PAUSE = 0.01  # s between exchanges
_ANSWER_TIMEOUT = 1.0  # s for an answer that a twin has sent to arrive


class FrankaHandClient:
    """One hand, in the driver's process; its state comes every 20 to 50 ms."""

    def __init__(self, address: str, force: float, lock_step: bool = False) -> None:
        """Connect; with `lock_step` the hand advances only when `advance` is called."""
        self.period = NEVER if lock_step else PERIOD
        self._issued = 0  # commands sent to the hand
        self._answered: int | None = None  # commands that a twin says it has answered
        self._franky, self._force = FRANKY.load("franky"), force
        self._hand = self._franky.Gripper(address)
        self._max_width = self._hand.state.max_width
        if self._max_width <= 0:
            raise UserError("the Franka Hand does not know its stroke: home it in Desk first")
        self._running: franky.BoolFuture | None = None
        self._target = self._hand.state.width
        self._commands = HandCommands(self._target)
        self._fault, self._clock = "", -1
        self._stopped = False
        self._reading = self._measure()

    def read(self) -> GripperReading:
        """Return the state as of the last tick, with the newest fault."""
        return replace(self._reading, fault=self._fault)

    def command(self, width: float) -> None:
        """Set a new target (m)."""
        if self._fault or self._stopped:
            raise DriverError(f"no command is taken: {self._fault or 'the hand was stopped'}")
        self._target = min(max(width, 0.0), self._max_width)

    def stop(self, release_to: float | None = None) -> None:
        """End the running command and send no other, except to open to a width (m)."""
        if not self._stopped and self._running is not None and not self._running.wait(0.0):
            self._hand.stop_async().wait(_STOP_TIMEOUT)
        self._stopped, self._running = True, None
        if release_to is not None:
            width = min(max(release_to, 0.0), self._max_width)
            self._running = self._hand.move_async(width, SPEED)

    def tick(self) -> None:
        """Read the state and send the next command, if any."""
        try:
            self._reading = self._measure()
            if not self._fault and not self._stopped:
                self._send()
        except Exception as error:
            self._fault = f"{type(error).__name__}: {' '.join(str(error).split())}"

    def advance(self, answered: int) -> int:
        """Tick, with the number of commands that a twin has answered; return the number sent."""
        self._answered = answered
        self.tick()
        return self._issued

    def close(self) -> None:
        """See Gripper."""

    def _measure(self) -> GripperReading:
        state = self._hand.state
        clock, stamp = state.time.to_msec(), time.monotonic()
        if clock == self._clock:
            stamp = self._reading.stamp
        self._clock = clock
        return GripperReading(state.width, state.is_grasped, self._fault, stamp)

    def _last_command(self) -> LastCommand:
        """Return how the last command stands; raise its error."""
        if self._running is None:
            return "arrived"
        arrives = self._answered is not None and self._answered >= self._issued
        if not self._running.wait(_ANSWER_TIMEOUT if arrives else 0.0):
            return "runs"
        arrived, self._running = self._running.get(), None
        return "arrived" if arrived else "stopped short"

    def _send(self) -> None:
        state, last = self._reading, self._last_command()
        command = self._commands.next(self._target, state.width, state.grasped, last)
        if command is None:
            return
        self._issued += 1
        if not command.grasp:
            self._running = self._hand.move_async(command.width, SPEED)
            return
        self._running = self._hand.grasp_async(  # an object met earlier counts as grasped
            command.width,
            SPEED,
            self._force,
            epsilon_inner=command.width,
            epsilon_outer=self._max_width,
        )


class FrankaHand:
    """Gripper over a Franka Hand; it closes with `force` (N, 30 to 70)."""

    def __init__(self, address: str, force: float = 30.0, lock_step: bool = False) -> None:
        own = FrankaHandClient, address, force, lock_step
        self._process = DriverProcess(*own, call_timeout=call_timeout(lock_step))

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


class NonBlockingGripper:
    """Gripper over another one behind a thread: a Franka Hand takes up to 50 ms to answer."""

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        self._wanted: float | None = None
        self._lock, self._stopped = threading.Lock(), False
        self._latest = LatestValue("gripper", self._take)

    def read(self) -> GripperReading:
        """See Gripper."""
        return self._latest.read()

    def command(self, width: float) -> None:
        """See Gripper; a fault shows in the next reading."""
        if self._stopped:
            raise DriverError("no command is taken: the gripper was stopped")
        self._wanted = width

    def stop(self, release_to: float | None = None) -> None:
        """See Gripper. Both hold the lock, so that no earlier width is sent after the stop."""
        with self._lock:
            self._stopped = True
            self._gripper.stop(release_to)

    def close(self) -> None:
        """See Gripper."""
        self._latest.close()
        self._gripper.close()

    def _take(self) -> GripperReading:
        time.sleep(_PAUSE)
        reading = self._gripper.read()
        with self._lock:
            wanted = None if self._stopped else self._wanted
            if wanted is not None and not reading.fault:
                self._gripper.command(wanted)
        return reading

"""Franka Hand through franky-control, in a child process.

The hand takes one slow command at a time, while a policy asks for a width every tick. The newest
width is sent when the last command is done, which is after 0.8 s at most: franky cannot interrupt one
(measured: its stop waits for the end). Closing grasps with a force limit and keeps what it meets on
the way; opening moves.
"""

import time

from touchgoal.control.child import Child
from touchgoal.control.errors import UserError
from touchgoal.control.protocols import DriverError, GripperReading

_STEP = 2e-3  # m between commands that differ
_SPEED = 0.1  # m/s; the hand's fastest


class FrankaHandClient:
    """In the child: one hand. Its state comes every 20 to 50 ms."""

    period = 0.05

    def __init__(self, address: str, force: float) -> None:
        import franky

        self._franky, self._force = franky, force
        self._hand = franky.Gripper(address)
        self._max_width = self._hand.state.max_width
        if self._max_width <= 0:
            raise UserError("the Franka Hand does not know its stroke: home it in Desk first")
        self._running: franky.BoolFuture | None = None
        self._sent = self._target = self._hand.state.width
        self._fault, self._clock = "", -1
        self._reading = self._measure()

    def read(self) -> GripperReading:
        """The state as of the last tick."""
        return self._reading

    def command(self, width: float) -> None:
        """A new target (m)."""
        if self._fault:
            raise DriverError(f"no command is taken: {self._fault}")
        self._target = min(max(width, 0.0), self._max_width)

    def stop(self) -> None:
        """Send nothing more."""
        self._target = self._sent

    def tick(self) -> None:
        """Read the state; send the target if it is news."""
        try:
            self._reading = self._measure()
            if not self._fault and abs(self._target - self._sent) > _STEP:
                self._go(self._target)
        except Exception as error:
            self._fault = f"{type(error).__name__}: {' '.join(str(error).split())}"

    def close(self) -> None:
        """See Gripper."""

    def _measure(self) -> GripperReading:
        state = self._hand.state
        clock, stamp = state.time.to_msec(), time.monotonic()
        if clock == self._clock:
            stamp = self._reading.stamp
        self._clock = clock
        return GripperReading(state.width, state.is_grasped, self._fault, stamp)

    def _go(self, width: float) -> None:
        if self._running is not None:
            if not self._running.wait(0.0):
                return
            self._running.get()  # raises what went wrong
        if width < self._sent:
            # What is met before `width` counts as grasped, whatever its size.
            self._running = self._hand.grasp_async(
                width, _SPEED, self._force, epsilon_inner=width, epsilon_outer=self._max_width
            )
        else:
            self._running = self._hand.move_async(width, _SPEED)
        self._sent = width


class FrankaHand:
    """The Gripper protocol over a hand; it closes with `force` (N, 30 to 70)."""

    def __init__(self, address: str, force: float = 30.0) -> None:
        self._child = Child(FrankaHandClient, address, force)

    def read(self) -> GripperReading:
        """See Gripper."""
        return self._child.call("read")

    def command(self, width: float) -> None:
        """See Gripper."""
        self._child.call("command", width)

    def stop(self) -> None:
        """See Gripper."""
        self._child.call("stop")

    def close(self) -> None:
        """See Gripper."""
        self._child.close()

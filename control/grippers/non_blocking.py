"""A gripper behind a thread, for drivers whose answers take longer than a control loop can wait."""

import time

from touchgoal.control.interfaces import Gripper, GripperReading
from touchgoal.control.sensors.latest_value import LatestValue

_PAUSE = 0.01  # s between exchanges


class NonBlockingGripper:
    """The Gripper protocol over another one (measured: a Franka Hand answers in up to 50 ms)."""

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        self._wanted: float | None = None
        self._latest = LatestValue("gripper", self._take)

    def read(self) -> GripperReading:
        """See Gripper."""
        return self._latest.read()

    def command(self, width: float) -> None:
        """See Gripper; a fault shows in the next reading."""
        self._wanted = width

    def stop(self) -> None:
        """See Gripper."""
        self._wanted = None
        self._gripper.stop()

    def close(self) -> None:
        """See Gripper."""
        self._latest.close()
        self._gripper.close()

    def _take(self) -> GripperReading:
        time.sleep(_PAUSE)
        reading, wanted = self._gripper.read(), self._wanted
        if wanted is not None and not reading.fault:
            self._gripper.command(wanted)
        return reading

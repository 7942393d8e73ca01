"""A gripper behind a thread, for drivers that answer more slowly than a control loop can wait."""

import threading
import time

from touchgoal.control.interfaces import DriverError, Gripper, GripperReading
from touchgoal.control.sensors.latest_value import LatestValue

_PAUSE = 0.01  # s between exchanges


class NonBlockingGripper:
    """Gripper over another one whose answers are slow (a Franka Hand: up to 50 ms)."""

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
        """See Gripper. No width that was read before is sent after it: both hold the lock."""
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

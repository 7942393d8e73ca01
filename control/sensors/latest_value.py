"""A thread that reads a device and holds its latest reading."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from touchgoal.control.interfaces import DriverError

T = TypeVar("T")
_CLOSE_TIMEOUT = 15.0  # s; the slowest poll, of a lock-step twin's images, takes 10


class LatestValue(Generic[T]):
    """Latest reading of `poll`, which is called over and over; None is no reading.

    `poll` must return within about a second. Its exception ends the thread, and `read` then raises
    a DriverError with the same text.
    """

    def __init__(self, name: str, poll: Callable[[], T | None], timeout: float = 5.0) -> None:
        self._name, self._poll, self._timeout = name, poll, timeout
        self._value: T | None = None
        self._error: Exception | None = None
        self._updated, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def read(self) -> T:
        """Return the latest reading; wait up to `timeout` s for the first one."""
        self._updated.wait(self._timeout)
        if self._error is not None:
            raise DriverError(f"{self._name}: {self._error}") from self._error
        if self._value is None:
            raise DriverError(f"{self._name} gives nothing: check cable, power and settings")
        return self._value

    def close(self) -> None:
        """End the thread, so that the device may be released; one that hangs is left behind."""
        self._stop.set()
        self._thread.join(_CLOSE_TIMEOUT)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                value = self._poll()
            except Exception as error:  # of any library; `read` passes it on
                self._error = error
                self._updated.set()
                return
            if value is not None:
                self._value = value
                self._updated.set()

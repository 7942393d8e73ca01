"""A driver in its own process, which is ended in time if it hangs, crashes or loses its parent.

Vendors' client libraries hang on a taken robot, ignore Ctrl-C and crash when a link drops. The
process ends when a call is not answered in time, when the parent dies (the pipe closes), or by the
kernel's alarm when the library hangs. A controller stops its arm when its client is gone.
"""

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from typing import Any, Protocol, runtime_checkable

from touchgoal.control.interfaces import DriverError
from touchgoal.runtime.errors import UserError

_CALL_TIMEOUT = 1.5  # s, of an arm or hand that may move
_GRACE = 1.0  # s that the kernel's alarm waits beyond the parent's time-out
_CLOSING = 3.0  # s to bring an arm to rest and disconnect
NEVER = 1e6  # s, period of a driver that ticks on request alone
_EXIT_WITH_REASON = 3  # exit code; the reason is the last line of output


def call_timeout(lock_step: bool) -> float:
    """Return how long (s) a call may take; while a twin in lock-step is late, nothing moves."""
    return 60.0 if lock_step else _CALL_TIMEOUT


@runtime_checkable
class Driver(Protocol):
    """Driver in the child process: `tick` runs every `period` s, other methods on the parent's call."""

    period: float

    def tick(self) -> None:
        """Keep the device going; an exception ends the process at once, without `close`."""

    def close(self) -> None:
        """Bring the device to rest and disconnect."""


class DriverProcess:
    """Parent's end of the pipe: makes `driver(*args)` in a child process and calls its methods.

    `driver` is a class at the top of an importable module; arguments and answers are pickled. Calls
    may come from several threads, not from a signal handler. `exit_reason` says why the process
    ended; it is empty while it runs. UserError or DriverError: raised by the driver, or it did not
    connect in time.
    """

    def __init__(
        self,
        driver: Callable[..., Driver],
        *args: Any,
        connect_timeout: float = 30.0,
        call_timeout: float = _CALL_TIMEOUT,
    ) -> None:
        self._name, self._lock = driver.__qualname__, threading.Lock()
        self._timeout = call_timeout
        self.exit_reason = ""
        self._output = tempfile.TemporaryFile()
        self._pipe, theirs = Pipe()
        # Its own session: Ctrl-C is for the parent, which then stops the arm in good order.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "touchgoal.control.arms.driver_process", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=self._output,
            start_new_session=True,
        )
        theirs.close()
        self._exchange((driver, args, connect_timeout), connect_timeout, "connect")

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def call(self, method: str, *args: Any) -> Any:
        """Return the method's result; DriverError if it fails, or takes too long and is killed."""
        return self._exchange((method, args, self._timeout), self._timeout, method)

    def close(self) -> None:
        """Let the driver bring its device to rest, then end it, by force if need be."""
        if self.alive:
            self._pipe.close()
            try:
                self._process.wait(_CLOSING + _GRACE)
            except subprocess.TimeoutExpired:
                self._kill()
        self.exit_reason = self.exit_reason or f"{self._name} is closed"
        self._pipe.close()
        self._output.close()

    def _exchange(self, request: Any, timeout: float, what: str) -> Any:
        with self._lock:
            try:
                self._pipe.send(request)
                if not self._pipe.poll(timeout):
                    self._kill()
                    self.exit_reason = (
                        f"{self._name} did not {what} within {timeout:g} s and was ended: check "
                        "power, cable and address, and that no other program holds the device"
                    )
                    raise DriverError(self.exit_reason)
                failure, result = self._pipe.recv()
            except (EOFError, OSError) as error:
                self.exit_reason = self.exit_reason or self._read_exit_reason()
                raise DriverError(self.exit_reason) from error
        if failure is not None:
            raise failure
        return result

    def _kill(self) -> int:
        self._process.kill()
        return self._process.wait()

    def _read_exit_reason(self) -> str:
        try:
            code = self._process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            code = self._kill()
        self._output.seek(0)
        lines = self._output.read().decode(errors="replace").split("\n")
        last = next((line.strip()[:200] for line in reversed(lines) if line.strip()), "")
        if code == _EXIT_WITH_REASON:
            return last
        how = signal.Signals(-code).name if code < 0 else f"code {code}"
        return f"{self._name} ended by itself ({how}): {last or 'without a message'}"


def _picklable(error: Exception) -> Exception:
    """Return an exception that the parent can unpickle without the client's library."""
    if isinstance(error, UserError):
        return error
    return DriverError(error_line(error))


def error_line(error: Exception) -> str:
    """Return the message for a person, on one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, UserError) else f"{type(error).__name__}: {text}"


def _alarm(seconds: float) -> None:
    """Let the kernel end this process unless it calls again within `seconds`."""
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _answer(driver: Driver, pipe: Connection) -> None:
    method, args, timeout = pipe.recv()
    _alarm(timeout + _GRACE)
    try:
        reply = None, getattr(driver, method)(*args)
    except Exception as error:
        reply = _picklable(error), None
    pipe.send(reply)


def _serve(driver: Driver, pipe: Connection) -> None:
    """Tick and answer until the parent closes the pipe or dies."""
    due = time.monotonic()
    while True:
        _alarm(driver.period + _CLOSING)
        if pipe.poll(max(due - time.monotonic(), 0)):
            _answer(driver, pipe)
        now = time.monotonic()
        if now >= due:
            driver.tick()
            due = max(due + driver.period, now)


def _main(pipe: Connection) -> None:
    make, args, timeout = pickle.loads(pipe.recv_bytes())
    _alarm(timeout + _GRACE)
    try:
        driver = make(*args)
    except Exception as error:
        pipe.send((_picklable(error), None))
        return
    pipe.send((None, None))
    try:
        _serve(driver, pipe)
    except (EOFError, BrokenPipeError, ConnectionResetError):  # the parent closed, or is gone
        _alarm(_CLOSING)
        driver.close()
    except Exception as error:
        print(error_line(error), file=sys.stderr, flush=True)
        os._exit(_EXIT_WITH_REASON)


if __name__ == "__main__":
    _main(Connection(int(sys.argv[1])))
    os._exit(0)  # a client library's threads must not hold the process back

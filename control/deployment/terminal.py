"""The operator's terminal during a deployment: keys, signals, and one status line."""

import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, TextIO

import numpy as np

from touchgoal.control.deployment.control_loop import Request, TickStatus
from touchgoal.control.safety.action_filter import Mode
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.interruption import handling

_CTRL_C = "\x03"


class Keyboard:
    """Keys of a terminal while the context lasts; its settings are restored afterwards.

    Ctrl-C is read like any key, so that it interrupts nothing half done.
    """

    def __init__(self, terminal: TextIO) -> None:
        """Take a terminal, such as sys.stdin; UserError if it is none."""
        if not terminal.isatty():
            raise UserError("there is no keyboard to read: start it in a terminal, without a pipe")
        self._terminal = terminal.fileno()

    def __enter__(self) -> "Keyboard":
        self._before = termios.tcgetattr(self._terminal)
        tty.setcbreak(self._terminal)
        modes = termios.tcgetattr(self._terminal)
        modes[3] &= ~termios.ISIG
        termios.tcsetattr(self._terminal, termios.TCSANOW, modes)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the terminal and drop unread keys, so that the shell does not get them."""
        with suppress(termios.error):  # it has gone
            termios.tcsetattr(self._terminal, termios.TCSAFLUSH, self._before)

    def read_keys(self) -> str:
        """Return the keys since the last call, in order; "" if there are none.

        KeyboardInterrupt if Ctrl-C is among them, UserError if the terminal has gone.
        """
        keys = b""
        while select.select([self._terminal], [], [], 0)[0]:
            try:
                more = os.read(self._terminal, 1024)
            except OSError:
                more = b""
            if not more:
                raise UserError("the terminal has gone; start again in another one")
            keys += more
        typed = keys.decode("latin-1")
        if _CTRL_C in typed:
            raise KeyboardInterrupt
        return typed


HELP = (
    "space or Ctrl-C stops the arm, Enter ends it as done, n as not done; none is an emergency stop"
)
_KEY_REQUESTS: dict[str, Request] = {
    "\n": "done",
    "\r": "done",
    "n": "not done",
    " ": "stop",
    "q": "stop",
}
RECORDING_HELP = (
    "space or Ctrl-C stops the arm, Enter ends a success, n a failure, q discards; none is an "
    "emergency stop"
)
_RECORDING_REQUESTS: dict[str, Request] = {**_KEY_REQUESTS, "q": "discard"}
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_TICKS_PER_LINE = 4
_ASK_INTERVAL = 0.05  # s between looks for an answer


def say(text: str) -> None:
    """Print the report; on stderr if the reader of stdout has gone (Ctrl-C ends `tee`, too)."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # for later flushes of stdout
        print(text, file=sys.stderr, flush=True)


class Terminal:
    """Takes the operator's requests, and shows the state every few ticks."""

    def __init__(self, on_keys: Callable[[str], None] | None = None) -> None:
        """Read keys of a deployment, or those of a recording if `on_keys` takes all that is typed."""
        self._on_keys = on_keys
        self._key_requests = _RECORDING_REQUESTS if on_keys else _KEY_REQUESTS
        self._request: Request = ""
        self._tick_count = 0
        keys = sys.stdin if sys.stdin is not None and sys.stdin.isatty() else None
        self._keyboard = Keyboard(keys) if keys else None
        self._shows = sys.stdout is not None and sys.stdout.isatty()

    def operator_request(self) -> Request:
        """Return the operator's request; a stop outweighs what was typed before it."""
        if self._keyboard is not None and self._request != "stop":
            try:
                typed = self._keyboard.read_keys()
            except (KeyboardInterrupt, UserError):  # Ctrl-C, or the terminal has gone
                typed = " "
            if self._on_keys is not None:
                self._on_keys(typed)
            for key in typed:
                request = self._key_requests.get(key)
                if request == "stop" or (request and not self._request):
                    self._request = request
        return self._request

    def ask(self, question: str) -> bool | None:
        """Return what the operator answers by the keys of done and not done; None without an answer."""
        if self._keyboard is None:
            return None
        say(f"\n{question}: Enter if it is, n if not, q if you do not know")
        while not (request := self.operator_request()):
            time.sleep(_ASK_INTERVAL)
        answers: dict[Request, bool] = {"done": True, "not done": False}
        return answers.get(request)

    def show_tick(self, status: TickStatus) -> None:
        """Update the status line, every few ticks."""
        self._tick_count += 1
        if self._tick_count % _TICKS_PER_LINE or not self._shows:
            return
        state, reading = status.state, status.reading
        limits = ", ".join(state.active_limits)
        mode = f"{state.mode} ({limits})" if state.mode is Mode.MOVE and limits else state.mode
        force = float(np.linalg.norm(reading.arm.wrench[:3]))
        cost = ""
        if status.cost is not None:
            old = time.monotonic() - status.cost.stamp
            cost = f"cost {status.cost.cost:5.2f} {status.cost.verdict}"
            cost += f", {old:.0f} s old" if old > 1 else ""
        line = (
            f"{status.seconds:6.1f} s  {mode:<24}  {force:5.1f} N  "
            f"gel {1e3 * reading.indentation.max():3.1f} mm  gripper {1e3 * status.width:3.0f} mm  "
            f"images {1e3 * reading.age:4.0f} ms  late {1e3 * status.late:4.1f} ms  {cost}"
        )
        print(f"\r{line[:118]:<118}", end="", flush=True)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Take keys and signals as requests while this lasts."""
        try:
            with handling(_SIGNALS, self._on_signal), self._keyboard or nullcontext():
                yield
        finally:
            if self._shows:
                print()

    def _on_signal(self, *_: Any) -> None:
        self._request = "stop"

"""The operator's terminal during a deployment: keys, signals, and one line that is written over."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np

from touchgoal.control.deployment.control_loop import Request, TickStatus
from touchgoal.control.safety.action_filter import Mode
from touchgoal.control.sensors.keyboard import Keyboard
from touchgoal.runtime.errors import UserError

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
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_TICKS_PER_LINE = 4  # ticks between lines


class Terminal:
    """Asked every tick what the operator wants; shows every few ticks what happens."""

    def __init__(self) -> None:
        self._request: Request = ""
        self._tick_count = 0
        self._keyboard = Keyboard(sys.stdin) if sys.stdin.isatty() else None

    def operator_request(self) -> Request:
        """See ControlLoop. A stop outweighs what was typed before it."""
        if self._keyboard is not None and self._request != "stop":
            try:
                typed = self._keyboard.read_keys()
            except (KeyboardInterrupt, UserError):  # Ctrl-C, or the terminal has gone
                typed = " "
            for key in typed:
                request = _KEY_REQUESTS.get(key)
                if request == "stop" or (request and not self._request):
                    self._request = request
        return self._request

    def show_tick(self, status: TickStatus) -> None:
        """See ControlLoop."""
        self._tick_count += 1
        if self._tick_count % _TICKS_PER_LINE or not sys.stdout.isatty():
            return
        state, sensed = status.state, status.sensed
        active_limits = ", ".join(state.active_limits)
        mode = (
            state.mode
            if state.mode is not Mode.MOVE or not active_limits
            else f"{state.mode} ({active_limits})"
        )
        force = float(np.linalg.norm(sensed.arm.wrench[:3]))
        cost = "" if status.cost is None else f"cost {status.cost:5.2f}"
        line = (
            f"{status.seconds:6.1f} s  {mode:<24}  {force:5.1f} N  gel {1e3 * sensed.indentation.max():3.1f} mm  gripper {1e3 * status.width:3.0f} mm"
            f"  pictures {1e3 * sensed.age:4.0f} ms  late {1e3 * status.late:4.1f} ms  {cost}"
        )
        print(f"\r{line[:118]:<118}", end="", flush=True)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Keys and signals are taken as requests while this lasts, and then as before."""
        before = {number: signal.signal(number, self._on_signal) for number in _SIGNALS}
        try:
            with self._keyboard or nullcontext():
                yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            if sys.stdout.isatty():
                print()

    def _on_signal(self, *_: Any) -> None:
        self._request = "stop"

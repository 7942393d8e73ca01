"""The operator's terminal during a deployment: keys, signals, and one line that is written over."""

import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from touchgoal.control.safety import Mode
from touchgoal.policies.deployment import View

HELP = "space or Ctrl-C stops the arm, Enter ends the task; neither is an emergency stop"
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_REFRESH = 4  # ticks between lines


class Terminal:
    """Asked every tick what the operator wants; shows every few ticks what happens."""

    def __init__(self) -> None:
        self._asked, self._count = "", 0
        self._keys = sys.stdin.isatty()

    def wanted(self) -> str:
        """See Deployment."""
        while not self._asked and self._keys and select.select([sys.stdin], [], [], 0)[0]:
            self._asked = {"\n": "done", "\r": "done", " ": "stop", "q": "stop"}.get(
                sys.stdin.read(1), ""
            )
        return self._asked

    def show(self, view: View) -> None:
        """See Deployment."""
        self._count += 1
        if self._count % _REFRESH or not sys.stdout.isatty():
            return
        state, sensed = view.state, view.sensed
        acted = ", ".join(state.acted)
        mode = state.mode if state.mode is not Mode.MOVE or not acted else f"{state.mode} ({acted})"
        force = float(np.linalg.norm(sensed.arm.wrench[:3]))
        cost = "" if view.cost is None else f"cost {view.cost:5.2f}"
        line = (
            f"{view.seconds:6.1f} s  {mode:<24}  {force:5.1f} N  gel {1e3 * sensed.touch.max():3.1f} mm  gripper {1e3 * view.width:3.0f} mm"
            f"  pictures {1e3 * sensed.age:4.0f} ms  late {1e3 * view.late:4.1f} ms  {cost}"
        )
        print(f"\r{line[:118]:<118}", end="", flush=True)

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Keys and signals are taken as wishes while this lasts, and then as before."""
        before = {number: signal.signal(number, self._signalled) for number in _SIGNALS}
        settings = termios.tcgetattr(sys.stdin) if self._keys else None
        if self._keys:
            tty.setcbreak(sys.stdin)
        try:
            yield
        finally:
            if settings is not None:
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, settings)
            for number, handler in before.items():
                signal.signal(number, handler)
            if sys.stdout.isatty():
                print()

    def _signalled(self, *_: Any) -> None:
        self._asked = "stop"

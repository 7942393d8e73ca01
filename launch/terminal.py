"""The operator's terminal during a deployment: keys, signals, and one line that is written over."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np

from touchgoal.control.errors import UserError
from touchgoal.control.safety.action_filter import Mode
from touchgoal.control.sensors.keyboard import Keyboard
from touchgoal.policies.deploy.control_loop import View

HELP = "space or Ctrl-C stops the arm, Enter ends the task; neither is an emergency stop"
_WISHES = {"\n": "done", "\r": "done", " ": "stop", "q": "stop"}
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_REFRESH = 4  # ticks between lines


class Terminal:
    """Asked every tick what the operator wants; shows every few ticks what happens."""

    def __init__(self) -> None:
        self._asked, self._count = "", 0
        self._keyboard = Keyboard(sys.stdin) if sys.stdin.isatty() else None

    def wanted(self) -> str:
        """See Deployment. A stop outweighs what was typed before it."""
        if self._keyboard is not None and self._asked != "stop":
            try:
                wishes = {_WISHES.get(key, "") for key in self._keyboard.typed()}
            except (KeyboardInterrupt, UserError):  # Ctrl-C, or the terminal has gone
                wishes = {"stop"}
            self._asked = "stop" if "stop" in wishes else max(wishes, default="") or self._asked
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
        try:
            with self._keyboard or nullcontext():
                yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            if sys.stdout.isatty():
                print()

    def _signalled(self, *_: Any) -> None:
        self._asked = "stop"

"""Single key presses at a terminal, without Enter."""

import contextlib
import os
import select
import termios
import tty
from typing import TextIO

from touchgoal.runtime.errors import UserError

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
        with contextlib.suppress(termios.error):  # it has gone
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

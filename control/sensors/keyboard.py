"""Keys typed at a terminal, one by one, without waiting for Enter."""

import contextlib
import os
import select
import termios
import tty
from typing import TextIO

from touchgoal.runtime.errors import UserError

_CTRL_C = "\x03"


class Keyboard:
    """A terminal's keys while the context lasts; the terminal is then as it was before.

    Ctrl-C waits to be read like any key, so that it interrupts nothing half done.
    """

    def __init__(self, terminal: TextIO) -> None:
        """Takes the terminal, such as sys.stdin; UserError if it is none."""
        if not terminal.isatty():
            raise UserError("there is no keyboard to read: start it in a terminal, without a pipe")
        self._terminal = terminal.fileno()

    def __enter__(self) -> "Keyboard":
        """Keys come at once, and are not shown."""
        self._before = termios.tcgetattr(self._terminal)
        tty.setcbreak(self._terminal)
        modes = termios.tcgetattr(self._terminal)
        modes[3] &= ~termios.ISIG
        termios.tcsetattr(self._terminal, termios.TCSANOW, modes)
        return self

    def __exit__(self, *_: object) -> None:
        """What was typed and not read is dropped: it is not meant for the shell."""
        with contextlib.suppress(termios.error):  # it has gone
            termios.tcsetattr(self._terminal, termios.TCSAFLUSH, self._before)

    def read_keys(self) -> str:
        """The keys since the last call, in their order; "" if there are none.

        Raises:
            KeyboardInterrupt: Ctrl-C is among them.
            UserError: the terminal has gone.
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

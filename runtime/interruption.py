"""Ctrl-C and SIGTERM: what is done is kept, and the last line says so."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Terminated(KeyboardInterrupt):
    """SIGTERM; handled as Ctrl-C is."""


@contextmanager
def kept(message: Callable[[], str]) -> Iterator[None]:
    """Say what an interruption inside leaves behind.

    Args:
        message: asked only when interrupted: what was kept, and the command that goes on, such as
            "kept 7 of 20 episodes in runs/x; go on with: touchgoal … --resume".
    """
    try:
        yield
    except KeyboardInterrupt as interruption:
        interruption.add_note(message())
        raise


@contextmanager
def terminable() -> Iterator[None]:
    """While this lasts, SIGTERM raises `Terminated` in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated

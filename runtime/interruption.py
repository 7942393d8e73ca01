"""Ctrl-C and SIGTERM: finished work stays, and the command's last line says so."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Terminated(KeyboardInterrupt):
    """SIGTERM, handled as Ctrl-C."""


@contextmanager
def on_interruption(message: Callable[[], str]) -> Iterator[None]:
    """Add a note to an interruption of the block.

    `message`, called on interruption only, says what is saved and what command continues.
    """
    try:
        yield
    except KeyboardInterrupt as interruption:
        interruption.add_note(message())
        raise


@contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` in the main thread on SIGTERM during the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def stop_on_request() -> Iterator[Callable[[], bool]]:
    """Take Ctrl-C and SIGTERM in the block as a request, and yield a function that says if it came.

    Nothing is interrupted half done. Outside the main thread no request comes.
    """
    requests: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    numbers = signal.SIGINT, signal.SIGTERM
    before = [signal.signal(number, lambda n, _: requests.append(n)) for number in numbers]
    try:
        yield lambda: bool(requests)
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated

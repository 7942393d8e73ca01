"""Ctrl-C and SIGTERM: finished work stays, and the command's last line says so."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
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
def handling(
    numbers: Sequence[int], handler: Callable[[int, FrameType | None], object]
) -> Iterator[None]:
    """Handle signals in the block; outside the main thread, where that is impossible, do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [signal.signal(number, handler) for number in numbers]
    try:
        yield
    finally:
        for number, earlier in zip(numbers, before, strict=True):
            signal.signal(number, earlier)


@contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` in the main thread on SIGTERM during the block."""
    with handling([signal.SIGTERM], _terminate):
        yield


@contextmanager
def stop_on_request() -> Iterator[Callable[[], bool]]:
    """Take Ctrl-C and SIGTERM in the block as a request, and yield a function that says if it came.

    Nothing is interrupted half done. Outside the main thread no request comes.
    """
    requests: list[int] = []
    with handling([signal.SIGINT, signal.SIGTERM], lambda number, _: requests.append(number)):
        yield lambda: bool(requests)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated

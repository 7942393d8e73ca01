"""Progress of long work on stderr: a bar on a terminal, a line every half minute elsewhere."""

import sys
from collections.abc import Iterable, Iterator, Sized
from typing import Any, TypeVar

from tqdm import tqdm

_PERIOD = 30.0  # s between two updates where stderr is no terminal
Item = TypeVar("Item")


def progress_bar(what: str, total: int | None, unit: str) -> "tqdm[Any]":
    """Return a progress bar named `what`, such as "filming", that counts in a singular `unit`.

    `with progress_bar(…) as bar: … bar.update()`; the total is None if unknown.
    """
    terminal = sys.stderr.isatty()
    return tqdm(
        total=total,
        desc=what,
        unit=f" {unit}",
        dynamic_ncols=True,
        mininterval=0.1 if terminal else _PERIOD,
        delay=0.0 if terminal else _PERIOD,  # short work leaves no line in a file
    )


def track(items: Iterable[Item], what: str, unit: str, total: int | None = None) -> Iterator[Item]:
    """Iterate over items and count them; arguments as in `progress_bar`."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress_bar(what, total, unit) as bar:
        for item in items:
            yield item
            bar.update()

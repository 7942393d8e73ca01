"""Progress of long work: a bar on a terminal, a plain line now and then in a pipe or a file."""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from types import TracebackType
from typing import TypeVar

from tqdm import tqdm

_PERIOD = 30.0  # s between two lines in a pipe, at most
_SHARE = 0.1  # of the work between two lines in a pipe
_QUICK = 2.0  # s: no lines of work that is done sooner, nor lines closer together
Item = TypeVar("Item")


class Progress:
    """Counts units of work: `with Progress("filming", 161, "frame") as bar: … bar.update()`.

    Args:
        what: is being done.
        total: units in all; None if not known.
        unit: what is counted, in the singular.
    """

    def __init__(self, what: str, total: int | None, unit: str) -> None:
        self._what, self._total, self._unit = what, total, unit
        self._count, self._said = 0, 0
        self._start = self._said_at = time.monotonic()
        terminal = sys.stderr.isatty()
        self._bar = (
            tqdm(total=total, desc=what, unit=unit, dynamic_ncols=True) if terminal else None
        )

    def update(self, units: int = 1) -> None:
        """So many more units are done."""
        self._count += units
        if self._bar is not None:
            self._bar.update(units)
            return
        now = time.monotonic()
        quiet = now - self._said_at
        enough = self._total and self._count - self._said >= _SHARE * self._total
        if quiet >= _PERIOD or (quiet >= _QUICK and (enough or self._count == self._total)):
            self._said, self._said_at = self._count, now
            print(self._line(now - self._start), file=sys.stderr, flush=True)

    def _line(self, seconds: float) -> str:
        done = f"{self._count}" if self._total is None else f"{self._count} of {self._total}"
        rate = f", {seconds / self._count:.2g} s each" if self._count and seconds >= 1 else ""
        return f"{self._what}: {done} {_plural(self._unit)}, {seconds:.0f} s{rate}"

    def __enter__(self) -> "Progress":
        """Itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Ends the bar's line."""
        if self._bar is not None:
            self._bar.close()


def _plural(unit: str) -> str:
    if unit.endswith("y"):
        return unit.removesuffix("y") + "ies"
    return unit + ("es" if unit.endswith(("s", "sh", "ch")) else "s")


def track(items: Iterable[Item], what: str, unit: str, total: int | None = None) -> Iterator[Item]:
    """The items, counted as they are asked for the next one.

    Args:
        items: one unit of work each.
        what: is being done.
        unit: what is counted, in the singular.
        total: of items that have no length.
    """
    known = len(items) if total is None and isinstance(items, Sized) else total
    with Progress(what, known, unit) as bar:
        for item in items:
            yield item
            bar.update()

"""Result of a check: one line of a table, with its remedy."""

from collections.abc import Sequence
from dataclasses import dataclass

from touchgoal.runtime.errors import UserError

_MARKS = {True: "ok", False: "MISSING", None: "-"}


@dataclass(frozen=True)
class CheckResult:
    """One line of the report.

    Attributes:
        name: What was checked.
        ok: Whether it works; None for something optional that is absent.
        detail: What was found.
        remedy: What to do if it does not work.
    """

    name: str
    ok: bool | None
    detail: str
    remedy: str = ""

    def __str__(self) -> str:
        """Return the line."""
        remedy = f"  ->  {self.remedy}" if self.remedy else ""
        return f"{_MARKS[self.ok]:<9}{self.name:<18}{self.detail}{remedy}"


def require_all_ok(results: Sequence[CheckResult]) -> None:
    """Raise UserError if a check failed."""
    broken = [f for f in results if f.ok is False]
    if broken:
        raise UserError("; ".join(f"{f.name}: {f.remedy or f.detail}" for f in broken))

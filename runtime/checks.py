"""What a check found: one line of a table, and what to do about it."""

from collections.abc import Sequence
from dataclasses import dataclass

from touchgoal.runtime.errors import UserError

_MARKS = {True: "ok", False: "MISSING", None: "-"}


@dataclass(frozen=True)
class CheckResult:
    """One line of the report.

    Attributes:
        ok: whether it works; None for something optional that is not there.
        remedy: what to do if it does not.
    """

    name: str
    ok: bool | None
    detail: str
    remedy: str = ""

    def __str__(self) -> str:
        """The line."""
        remedy = f"  ->  {self.remedy}" if self.remedy else ""
        return f"{_MARKS[self.ok]:<9}{self.name:<18}{self.detail}{remedy}"


def require_all_ok(results: Sequence[CheckResult]) -> None:
    """UserError, so exit code 1, if something that is needed is missing."""
    broken = [f for f in results if f.ok is False]
    if broken:
        raise UserError("; ".join(f"{f.name}: {f.remedy or f.detail}" for f in broken))

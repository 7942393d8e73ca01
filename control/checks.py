"""What a check found: one line of a table, and what to do about it."""

from collections.abc import Sequence
from dataclasses import dataclass

from touchgoal.control.errors import UserError

_MARKS = {True: "ok", False: "MISSING", None: "-"}


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        ok: whether it works; None for something optional that is not there.
        mend: what to do if it does not.
    """

    what: str
    ok: bool | None
    says: str
    mend: str = ""

    def __str__(self) -> str:
        """The line."""
        mend = f"  ->  {self.mend}" if self.mend else ""
        return f"{_MARKS[self.ok]:<9}{self.what:<18}{self.says}{mend}"


def require(findings: Sequence[Finding]) -> None:
    """UserError, so exit code 1, if something that is needed is missing."""
    broken = [f for f in findings if f.ok is False]
    if broken:
        raise UserError("; ".join(f"{f.what}: {f.mend or f.says}" for f in broken))

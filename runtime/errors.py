"""Exception for a user's mistake, and results of checks with their remedies."""

import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

_MARKS = {True: "ok", False: "MISSING", None: "-"}


class UserError(ValueError):
    """Something that the user can correct; the message is one line that says how.

    Commands print the message and exit with 1; any other exception is a bug and shows its traceback.
    """


class RefusedError(UserError):
    """A policy does not act, because it is not sure of what it observes."""


@dataclass(frozen=True)
class CheckResult:
    """Result of a check: one line of a table."""

    name: str
    ok: bool | None  # None for something optional that is absent
    detail: str  # what was found
    remedy: str = ""  # what to do if it does not work

    def __str__(self) -> str:
        """Return the line."""
        remedy = f"  ->  {self.remedy}" if self.remedy else ""
        return f"{_MARKS[self.ok]:<9}{self.name:<18}{self.detail}{remedy}"


def require_all_ok(results: Sequence[CheckResult]) -> None:
    """Raise UserError if a check failed."""
    broken = [f for f in results if f.ok is False]
    if broken:
        raise UserError("; ".join(f"{f.name}: {f.remedy or f.detail}" for f in broken))


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """Return the error for a name that does not exist: the nearest one, and all that do."""
    known = list(known)
    close = get_close_matches(name, known, 1)
    guess = f"did you mean {close[0]}? Else " if close else ""
    return UserError(f"unknown {kind} {name!r}: {guess}choose from {', '.join(known)}")


def install_extra(extra: str) -> str:
    """Return the command that installs an extra, for messages.

    touchgoal is on no package index: the command names the clone that this code runs from, which an
    installed wheel does not know.
    """
    root = Path(__file__).resolve().parents[1]
    if (root / "pyproject.toml").is_file():
        return f"pip install -e '{root}[{extra}]'"
    return f"in the clone of touchgoal: pip install '.[{extra}]'"


def wheel_folder(module: str) -> Path:
    """Return the folder of a package of the extra `towers`, not imported; UserError if missing."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise UserError(f"the package {module} is missing: {install_extra('towers')}")
    return Path(spec.origin).parent

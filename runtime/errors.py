"""The one exception a user's mistake raises, and what its messages advise."""

from pathlib import Path


class UserError(ValueError):
    """A mistake that the person at the keyboard can mend; its message is one line saying how.

    Commands print the message and exit with 1; anything else is a bug and keeps its traceback.
    """


def install_extra(extra: str) -> str:
    """The command that installs one of our optional parts, for messages.

    touchgoal is on no package index, so it names the clone that this code runs from; an installed
    wheel does not know its clone.
    """
    root = Path(__file__).resolve().parents[1]
    if (root / "pyproject.toml").is_file():
        return f"pip install -e '{root}[{extra}]'"
    return f"in the clone of touchgoal: pip install '.[{extra}]'"

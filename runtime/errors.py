"""Exception for a user's mistake."""

from pathlib import Path


class UserError(ValueError):
    """A mistake that the user can correct; the message is one line that says how.

    Commands print the message and exit with 1; any other exception is a bug and shows its traceback.
    """


def install_extra(extra: str) -> str:
    """Return the command that installs an extra, for messages.

    touchgoal is on no package index: the command names the clone that this code runs from, which an
    installed wheel does not know.
    """
    root = Path(__file__).resolve().parents[1]
    if (root / "pyproject.toml").is_file():
        return f"pip install -e '{root}[{extra}]'"
    return f"in the clone of touchgoal: pip install '.[{extra}]'"

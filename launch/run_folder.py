"""Where a command leaves its results: one folder with the resolved config beside them."""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from touchgoal import __version__


def open_run(out: Path | None, command: str, config: Any) -> Path:
    """Make the folder, default `runs/<date>_<command>`, and write `config.json` into it.

    Args:
        out: the folder the user asked for.
        command: name of the command.
        config: its frozen dataclass.
    """
    folder = out or Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{command}"
    folder.mkdir(parents=True, exist_ok=True)
    record = {
        "command": command,
        "config": asdict(config),
        "argv": sys.argv,
        "touchgoal": __version__,
        "git": _commit(),
    }
    write_json(folder / "config.json", record)
    return folder


def write_json(path: Path, value: Any) -> None:
    """Write atomically, so that a reader never sees half a file."""
    partial = path.with_suffix(path.suffix + ".part")
    partial.write_text(json.dumps(value, indent=2, default=_plain) + "\n")
    os.replace(partial, path)


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else str(value)


def _commit() -> str | None:
    """The commit of a checkout; None for an installed package."""
    asked = subprocess.run(
        ["git", "-C", str(Path(__file__).resolve().parent), "rev-parse", "HEAD"],
        capture_output=True,
        text=True,
    )
    return asked.stdout.strip() or None

"""Where a command leaves its results: one folder with the record of the run beside them."""

import json
import tempfile
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.provenance import hardware, provenance, versions

RECORD = "config.json"


def check_writable(out: Path | None) -> None:
    """Leave nothing, but try to write where the folder of a run is to be.

    Raises:
        UserError: it is a file, or cannot be written to.
    """
    folder = out if out is not None else Path("runs")
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise UserError(f"--out: {folder} is a file; name a folder")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(f"--out: cannot write in {folder.resolve()}: {error.strerror}") from error


def open_run(out: Path | None, command: str, config: Any, adds: bool = False) -> Path:
    """Make the folder, default `runs/<date>_<command>`, and write the run's record into it.

    The record of the first run is `config.json`; later ones add `config_2.json` and so on.

    Args:
        out: the folder the user asked for.
        command: name of the command.
        config: its frozen dataclass.
        adds: whether this run goes on with what an earlier one left there: it adds episodes, or
            was resumed.

    Raises:
        UserError: the folder holds results of another run, or cannot be written to.
    """
    folder = out or _dated_folder(command)
    check_writable(folder)
    record = {
        "name": command,
        "config": json.loads(json.dumps(asdict(config), default=str)),
        **provenance(),
        "versions": versions(),
        "hardware": hardware(),
    }
    records = sorted(folder.glob("config*.json"))
    if not adds:
        _refuse_other_run(folder, record, records)
    folder.mkdir(parents=True, exist_ok=True)
    name = RECORD if not records else f"config_{len(records) + 1}.json"
    write_json(folder / name, record)
    return folder


def _dated_folder(command: str) -> Path:
    """A folder of `runs/` that is not there yet: two runs may begin in the same second."""
    dated = Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{command}"
    folder, number = dated, 1
    while folder.exists():
        number += 1
        folder = dated.with_name(f"{dated.name}_{number}")
    return folder


def _refuse_other_run(folder: Path, record: dict[str, Any], records: list[Path]) -> None:
    """UserError if the folder holds more than records of runs, and one with other options."""
    if not folder.exists() or not set(folder.iterdir()) - set(records):
        return
    for path in records:
        try:
            other = json.loads(path.read_text())
        except (OSError, ValueError):
            other = {}
        if any(other.get(key) != record[key] for key in ("name", "config")):
            raise UserError(
                f"{folder} holds the results of {other.get('command', 'another run')}; "
                "choose another --out"
            )

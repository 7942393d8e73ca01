"""Folder of a run: the results of a command and the record of how they were made."""

import json
import tempfile
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.folder_lock import FolderLock
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.provenance import hardware, provenance, versions

RECORD = "config.json"
_held: dict[Path, FolderLock] = {}


def check_writable(out: Path | None) -> None:
    """Raise UserError unless the folder of a run can be made and written to; leave nothing."""
    folder = out if out is not None else Path("runs")
    try:
        while not folder.exists():
            if folder.is_symlink():
                raise UserError(f"--out: {folder} is a link that leads nowhere; name a folder")
            folder = folder.parent
        if not folder.is_dir():
            raise UserError(f"--out: {folder} is a file; name a folder")
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(f"--out: cannot write in {folder}: {error.strerror}") from error


def open_run(out: Path | None, command: str, config: Any, adds: bool = False) -> Path:
    """Make the folder of a run, lock it until `release_runs`, and write the run's record into it.

    The folder is `runs/<date>_<command>` where the user named none. The first run's record is
    `config.json`; later ones, which add to what the folder holds, are `config_2.json` and so on.
    UserError: another process writes into the folder, it holds the results of another run, or it
    cannot be written to.
    """
    folder = out or _dated_folder(command)
    check_writable(folder)
    if (key := folder.resolve()) not in _held or not key.exists():  # commands of a process share it
        _held[key] = FolderLock(
            folder, "another command is writing into {}: wait for it or name another --out"
        )
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
    name = RECORD if not records else f"config_{len(records) + 1}.json"
    write_json(folder / name, record)
    return folder


def release_runs() -> None:
    """Release the folders of this process's runs."""
    while _held:
        _held.popitem()[1].release()


def _dated_folder(command: str) -> Path:
    """Return an unused folder of `runs/`: two runs may begin in the same second."""
    dated = Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{command}"
    folder, number = dated, 1
    while folder.exists():
        number += 1
        folder = dated.with_name(f"{dated.name}_{number}")
    return folder


def _refuse_other_run(folder: Path, record: dict[str, Any], records: list[Path]) -> None:
    """Raise UserError if the folder holds results, and the record of a run with other options."""
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

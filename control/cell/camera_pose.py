"""A camera's calibrated pose and field of view, written into a cell file."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import write_json


def camera_lines(values: dict[str, Any]) -> str:
    """Return keys of a camera's section as lines of TOML; values are numbers or lists of numbers."""
    return "\n".join(f"{key} = {value}" for key, value in values.items())


def write_camera(path: Path, name: str, values: dict[str, Any]) -> None:
    """Set keys of `[cameras.NAME]` in a cell file, TOML or JSON, and leave all else as it is.

    UserError with the lines to paste if a TOML file has no such heading, or is written in a way that
    this cannot edit.
    """
    text = path.read_text(encoding="utf-8-sig")
    if path.suffix == ".json":
        table = json.loads(text)
        table["cameras"][name] |= values
        write_json(path, table)
        return
    wanted = tomllib.loads(text)
    wanted["cameras"][name] |= values
    edited = _edited(text, name, values)
    try:
        sound = edited is not None and tomllib.loads(edited) == wanted
    except tomllib.TOMLDecodeError:
        sound = False
    if not sound or edited is None:
        raise UserError(
            f"{path} cannot be edited: put these lines under [cameras.{name}]:\n{camera_lines(values)}"
        )
    write_file(path, edited.encode())


def _edited(text: str, name: str, values: dict[str, Any]) -> str | None:
    """Return the file with the section's keys replaced; None without the section's heading."""
    heading = re.search(rf"^\[cameras\.{name}\].*\n?", text, re.MULTILINE)
    if heading is None:
        return None
    before, after = text[: heading.end()].rstrip("\n"), text[heading.end() :]
    end = re.search(r"^\[", after, re.MULTILINE)
    section, rest = (after[: end.start()], after[end.start() :]) if end else (after, "")
    section = re.sub(rf"^({'|'.join(values)})\s*=.*\n?", "", section, flags=re.MULTILINE)
    return f"{before}\n{camera_lines(values)}\n{section}{rest}"

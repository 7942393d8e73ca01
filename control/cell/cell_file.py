"""Reading and writing cell files: TOML by a person or JSON by a twin, one set of keys."""

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from touchgoal.control.cell.checks import check
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.config_file import first_mistake, read_config
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import write_json

EXAMPLES = Path(__file__).parent / "examples"
CELLS = {path.stem: path for path in sorted(EXAMPLES.glob("*.toml")) if path.stem != "wand"}
"""The shipped cell files by name; wand.toml is collect-touches' own."""


def find_cell_file(path: Path) -> Path:
    """Return the path, or the shipped example of that name; UserError if there is neither."""
    if path.is_file():
        return path
    name = path.name.removesuffix(".toml")
    if path.parent in (Path("."), Path("control/cell/examples")) and name in CELLS:
        return CELLS[name]
    raise UserError(
        f"there is no cell file {path}; a twin writes its own (touchgoal twin), and these examples "
        f"can be named: {', '.join(CELLS)} (in {EXAMPLES})"
    )


def read_cell_file(
    path: Path,
    policy: str = "",
    sim: bool = False,
    seed: int | None = None,
    task: str = "",
    target: str | None = None,
) -> CellConfig:
    """Read a cell file: TOML, or the `cell.json` that a twin has written.

    `policy`, `seed`, `task` (its name) and `target` replace the file's, `sim` its arm by a simulated
    one.
    UserError as `read_config`, and if the sections do not fit together.
    """
    cell = read_config(path, CellConfig, "cell file")
    try:
        if policy:
            cell = replace(cell, task=replace(cell.task, policy=policy))
        if task and task != cell.task.name:
            renamed = replace(cell.task, name=task, scene=cell.task.simulated, instruction="")
            cell = replace(cell, task=renamed)
        if target is not None:
            cell = replace(cell, task=replace(cell.task, target=target))
        check(cell)
        if sim:
            cell = replace(cell, arm="sim")
        if seed is not None:
            if cell.arm != "sim" and not cell.task.twin:
                raise UserError("--seed sets a simulated scene; leave it out on a real arm")
            cell = replace(cell, task=replace(cell.task, seed=seed))
    except ValidationError as error:
        raise UserError(f"{path}: {first_mistake(error, CellConfig)}") from error
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return cell


def cell_table(cell: CellConfig) -> dict[str, Any]:
    """Return a cell as JSON-able keys of a cell file, without defaults."""
    return TypeAdapter(CellConfig).dump_python(cell, mode="json", exclude_defaults=True)


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

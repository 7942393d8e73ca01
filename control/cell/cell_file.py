"""Reading and writing cell files: TOML by a person or JSON by a twin, one set of keys."""

import json
import tomllib
from dataclasses import is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from touchgoal.control.cell.checks import check
from touchgoal.control.cell.config import CellConfig
from touchgoal.runtime.errors import UserError

_CELL = TypeAdapter(CellConfig)


EXAMPLES = Path(__file__).parent / "examples"


def find_cell_file(path: Path) -> Path:
    """Return the path, or the shipped example of that name; UserError if there is neither."""
    if path.is_file():
        return path
    names = sorted(example.stem for example in EXAMPLES.glob("*.toml"))
    example = EXAMPLES / f"{path.name.removesuffix('.toml')}.toml"
    if path.parent in (Path("."), Path("control/cell/examples")) and example.is_file():
        return example
    raise UserError(
        f"there is no cell file {path}; a twin writes its own (touchgoal twin), and these examples "
        f"can be named: {', '.join(names)} (in {EXAMPLES})"
    )


def read_cell_file(
    path: Path, policy: str = "", sim: bool = False, seed: int | None = None
) -> CellConfig:
    """Read a cell file: TOML, or the `cell.json` that a twin has written.

    `policy` and `seed` replace the file's, `sim` its arm by a simulated one. UserError if there is
    no such file, bad syntax, an unknown key, or a value that is missing or not allowed; one line
    with file, key, what is allowed and what is meant.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # with or without a byte-order mark
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise UserError(f"cannot read the cell file {path}: {error.strerror}") from error
    except (
        tomllib.TOMLDecodeError,
        json.JSONDecodeError,
        UnicodeDecodeError,
        RecursionError,
    ) as error:
        form = "JSON" if path.suffix == ".json" else "TOML"
        raise UserError(f"{path} is no {form}: {error}") from error
    _refuse_control_characters(path, table)
    try:
        # By way of JSON, in which lists pass for tuples and nothing else is converted.
        cell = _CELL.validate_json(json.dumps(table, default=str), strict=True)
        if policy:
            cell = replace(cell, task=replace(cell.task, policy=policy))
        check(cell)
        if sim:
            cell = replace(cell, arm="sim")
        if seed is not None:
            if cell.arm != "sim" and not cell.task.twin:
                raise UserError("--seed sets a simulated scene; leave it out on a real arm")
            cell = replace(cell, task=replace(cell.task, seed=seed))
    except ValidationError as error:
        raise UserError(f"{path}: {_explain(error)}") from error
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return cell


def cell_table(cell: CellConfig) -> dict[str, Any]:
    """Return a cell as JSON-able keys of a cell file, without defaults."""
    return _CELL.dump_python(cell, mode="json", exclude_defaults=True)


def _refuse_control_characters(path: Path, value: Any, name: str = "") -> None:
    """UserError if a text has escapes or line breaks: it is printed on the operator's terminal."""
    if isinstance(value, dict):
        for key, part in value.items():
            _refuse_control_characters(path, part, f"{name}.{key}".lstrip("."))
    elif isinstance(value, list):
        for part in value:
            _refuse_control_characters(path, part, name)
    elif isinstance(value, str) and not value.isprintable():
        raise UserError(f"{path}: {name} has control characters, {value!r}: leave them out")


def _explain(error: ValidationError) -> str:
    """Return the first mistake in one line; unknown keys first, often misspelt ones."""
    found = error.errors()
    unknown = [e for e in found if e["type"] == "unexpected_keyword_argument"]
    first = (unknown or found)[0]
    *where, key = (str(part) for part in first["loc"] if part != "[key]")
    name = ".".join((*where, key))
    if unknown:
        keys = list(_section(where).__pydantic_fields__)
        near = get_close_matches(key, keys, 1)
        meant = f"did you mean {near[0]}? " if near else ""
        return f"{name} is unknown: {meant}There are: {', '.join(keys)}"
    meaning = _meaning(first["loc"])
    kind, value = first["type"], first["input"]
    if isinstance(first["loc"][-1], int) and kind == "missing":
        return f"{'.'.join(where)} has too few values, {value!r}: {meaning}"
    if kind == "too_long" and "ctx" in first:
        return f"{name} must have {first['ctx']['max_length']} values, not {value!r}: {meaning}"
    if kind == "missing":
        return f"{name} is missing: {meaning}"
    rule = first["msg"].replace("Input should", "must")
    if kind == "dataclass_type":
        rule = "must be a section with keys of its own"
    return f"{name} {rule}, not {value!r}: {meaning}"


def _section(where: list[str]) -> Any:
    """Return the dataclass of a section."""
    kind: Any = CellConfig
    for key in where:
        kind = _dataclass_in(get_type_hints(kind).get(key)) or kind
    return kind


def _dataclass_in(hint: Any) -> Any:
    """Return the dataclass in a type hint, if any."""
    if is_dataclass(hint):
        return hint
    return next((kind for part in get_args(hint) if (kind := _dataclass_in(part))), None)


def _meaning(location: tuple[int | str, ...]) -> str:
    """Return the description of a key's field."""
    keys = [str(part) for part in location]
    for end in range(len(keys), 0, -1):
        found = _section(keys[: end - 1]).__pydantic_fields__.get(keys[end - 1])
        if found is not None and found.description:
            return " ".join(found.description.split()).rstrip(".")
    return "see docs/runbook.md"

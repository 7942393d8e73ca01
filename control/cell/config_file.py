"""Files that a lab writes: TOML by a person or JSON by a twin, as checked dataclasses."""

import json
import tomllib
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from touchgoal.runtime.errors import UserError, unknown_name

Config = TypeVar("Config")


def read_config(path: Path, kind: type[Config], name: str) -> Config:
    """Read a file as a strict pydantic dataclass; `name` is what it is called in a message.

    UserError if there is no such file, bad syntax, an unknown key, or a value that is missing or not
    allowed; one line with file, key, what is allowed and what is meant.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # with or without a byte-order mark
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise UserError(f"cannot read the {name} {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # in the text, or in its encoding
        form = "JSON" if path.suffix == ".json" else "TOML"
        raise UserError(f"{path} is no {form}: {error}") from error
    _check_texts(path, table)
    try:
        # By way of JSON, in which lists pass for tuples and nothing else is converted.
        return TypeAdapter(kind).validate_json(json.dumps(table, default=str), strict=True)
    except ValidationError as error:
        raise UserError(f"{path}: {first_mistake(error, kind)}") from error


def first_mistake(error: ValidationError, kind: type) -> str:
    """Return the first mistake in a `kind` in one line; unknown keys first, often misspelt ones."""
    found = error.errors()
    unknown = [e for e in found if e["type"] == "unexpected_keyword_argument"]
    first = (unknown or found)[0]
    *where, key = (str(part) for part in first["loc"] if part != "[key]")
    name = ".".join((*where, key))
    if unknown:
        keys = list(_section(kind, where).__pydantic_fields__)
        return str(unknown_name(f"key in {'.'.join(where)}" if where else "key", key, keys))
    meaning = _meaning(kind, first["loc"])
    problem, value = first["type"], first["input"]
    if isinstance(first["loc"][-1], int) and problem == "missing":
        return f"{'.'.join(where)} has too few values, {value!r}: {meaning}"
    if problem == "too_long" and "ctx" in first:
        return f"{name} must have {first['ctx']['max_length']} values, not {value!r}: {meaning}"
    if problem == "missing":
        return f"{name} is missing: {meaning}"
    rule = first["msg"].replace("Input should", "must").removeprefix("Value error, ")
    if problem == "dataclass_type":
        rule = "must be a section with keys of its own"
    return f"{name} {rule}, not {value!r}: {meaning}"


def _check_texts(path: Path, value: Any, name: str = "") -> None:
    """UserError if a text is empty, or has escapes or line breaks: it is printed on a terminal."""
    if isinstance(value, dict):
        for key, part in value.items():
            _check_texts(path, part, f"{name}.{key}".lstrip("."))
    elif isinstance(value, list):
        for part in value:
            _check_texts(path, part, name)
    elif value == "":
        raise UserError(f"{path}: {name} is empty: give a value or leave it out")
    elif isinstance(value, str) and not value.isprintable():
        raise UserError(f"{path}: {name} has control characters, {value!r}: leave them out")


def _section(kind: Any, where: list[str]) -> Any:
    """Return the dataclass of a section."""
    for key in where:
        kind = _dataclass_in(get_type_hints(kind).get(key)) or kind
    return kind


def _dataclass_in(hint: Any) -> Any:
    """Return the dataclass in a type hint, if any."""
    if is_dataclass(hint):
        return hint
    return next((kind for part in get_args(hint) if (kind := _dataclass_in(part))), None)


def _meaning(kind: type, location: tuple[int | str, ...]) -> str:
    """Return the description of a key's field."""
    keys = [str(part) for part in location]
    for end in range(len(keys), 0, -1):
        found = _section(kind, keys[: end - 1]).__pydantic_fields__.get(keys[end - 1])
        if found is not None and found.description:
            return " ".join(found.description.split()).rstrip(".")
    return "see docs/runbook.md"

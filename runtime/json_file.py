"""JSON files: keys must be unique, and a file is written whole or not at all."""

import json
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from pydantic_core import to_json

from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError


def parse_json(data: bytes) -> Any:
    """Parse a JSON document; ValueError if it is not JSON, or repeats a key in one object."""
    try:
        return json.loads(data, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_json(path: Path, kind: Any, otherwise: str) -> Any:
    """Read what `write_json` wrote of a `kind`: a dataclass, or a dict of them such as dict[int, C].

    UserError, which says `otherwise`: there is no such file, or it holds something else.
    """
    try:
        return TypeAdapter(kind).validate_json(path.read_bytes())
    except (OSError, ValueError):
        raise UserError(otherwise) from None


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically: numpy scalars as numbers, NaN and infinity as null, else text."""
    write_file(path, to_json(value, indent=2, inf_nan_mode="null", fallback=_plain) + b"\n")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} is given twice")
    return value


def _plain(value: Any) -> Any:
    """Return what stands for a value that JSON does not know."""
    return value.item() if hasattr(value, "item") else str(value)

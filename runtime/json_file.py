"""JSON files: keys must be unique, and a file is written whole or not at all."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from touchgoal.runtime.atomic_write import write_file


def parse_json(data: bytes) -> Any:
    """Parse a JSON document; ValueError if it is not JSON, or repeats a key in one object."""
    try:
        return json.loads(data, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically: numpy scalars as numbers, NaN and infinity as null, else text."""
    write_file(path, (json.dumps(_plain(value), indent=2, allow_nan=False) + "\n").encode())


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} is given twice")
    return value


def _plain(value: Any) -> Any:
    """Return a value of JSON's types alone."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)

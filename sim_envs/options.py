"""Options by name: `make(task, camera_size=(96, 96))` in place of a config built by hand."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from touchgoal.runtime.errors import unknown_name

Config = TypeVar("Config")


def with_options(config: Config, options: Mapping[str, Any]) -> Config:
    """Return the config with the fields named in `options` replaced.

    UserError: there is no such field, or a value is out of its range.

    Args:
        options: new values by field name; for a nested config (`randomization`), a config or a
            mapping of its fields that change.
    """
    assert is_dataclass(config) and not isinstance(config, type)
    names = [field.name for field in fields(config)]
    changes = {}
    for name, value in options.items():
        if name not in names:
            raise unknown_name(f"option of {type(config).__name__}", name, names)
        current = getattr(config, name)
        nested = is_dataclass(current) and isinstance(value, Mapping)
        changes[name] = with_options(current, value) if nested else value
    return replace(config, **changes)

"""Options of every command, as they are typed; a positional argument has no dashes."""

from collections.abc import Iterator
from dataclasses import is_dataclass
from importlib import import_module
from typing import Any

import tyro

from touchgoal.launch.__main__ import COMMANDS
from touchgoal.launch.support.command_line import _bare, _members, _options


def options_by_command() -> dict[str, set[str]]:
    """Return the options of each command or sub-command, those of all its tasks together."""
    found = {}
    for command in COMMANDS:
        module: Any = import_module(f"touchgoal.launch.{command.replace('-', '_')}")
        for member, kind in _members(module.Config):
            envs = getattr(module, "ENVS", {"": None}).values()
            found[f"{command} {member}".strip()] = {o for env in envs for o in _typed(kind, env)}
    return found


def _typed(config_type: type, env: Any, prefix: str = "") -> Iterator[str]:
    for field, annotation, _ in _options(config_type):
        name = prefix + field.name.replace("_", "-")
        inner: Any = type(env) if field.name == "env" and env else _bare(annotation)
        if is_dataclass(inner):
            yield from _typed(inner, env, name + ".")
        else:
            positional = tyro.conf.Positional in getattr(annotation, "__metadata__", ())
            yield name if positional else f"--{name}"

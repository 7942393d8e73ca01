"""Options of every command."""

from collections.abc import Iterator
from importlib import import_module
from typing import Any

from touchgoal.launch.__main__ import COMMANDS
from touchgoal.launch.support.command_line import all_options, members

Option = tuple[tuple[type, str], str]
"""Class and field, and the option as it is typed; a positional argument has no dashes."""


def options_by_command() -> Iterator[tuple[str, set[Option]]]:
    """Yield each command or sub-command with its options, those of all its tasks together."""
    for command in COMMANDS:
        module: Any = import_module(f"touchgoal.launch.{command.replace('-', '_')}")
        envs = getattr(module, "ENVS", {"": None}).values()
        for member, kind in members(module.Config):
            yield f"{command} {member}", {o[:2] for env in envs for o in all_options(kind, env)}

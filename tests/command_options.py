"""Options of every command."""

from importlib import import_module
from typing import Any

from touchgoal.launch.__main__ import COMMANDS
from touchgoal.launch.support.command_line import all_options, members


def options_by_command() -> dict[str, dict[str, tuple[type, str]]]:
    """Return each command's or sub-command's options as typed (those of all tasks): class and field.

    A positional argument has no dashes.
    """
    found = {}
    for command in COMMANDS:
        module: Any = import_module(f"touchgoal.launch.{command.replace('-', '_')}")
        envs = getattr(module, "ENVS", {"": None}).values()
        for member, kind in members(module.Config):
            own = {o: key for env in envs for key, o, _ in all_options(kind, env)}
            found[f"{command} {member}".strip()] = own
    return found

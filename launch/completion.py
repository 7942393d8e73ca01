"""Print a script that completes commands and options: eval "$(touchgoal completion bash)"."""

import importlib
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

import tyro

from touchgoal.runtime.option_types import checked_dataclass


@checked_dataclass
class Config:
    """Options of completion."""

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """Shell. Put the line in ~/.bashrc or ~/.zshrc; for fish:
    touchgoal completion fish > ~/.config/fish/completions/touchgoal.fish"""


def main(config: Config) -> None:
    """Print the script."""
    from touchgoal.launch.__main__ import COMMANDS
    from touchgoal.launch.support.command_line import print_completion

    kinds: list[Any] = []
    for name, meaning in COMMANDS.items():
        module = importlib.import_module(f"touchgoal.launch.{name.replace('-', '_')}")
        kinds.append(Annotated[module.Config, tyro.conf.subcommand(name, description=meaning)])
    print_completion(reduce(or_, kinds), config.shell)

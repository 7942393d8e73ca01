"""Check a set of episodes, and with --mend put right what an interrupted recording left."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.control.errors import UserError
from touchgoal.episodes.store import repair, validate


@dataclass(frozen=True)
class Config:
    """Options of repair."""

    root: Annotated[Path, tyro.conf.Positional]
    """The set: the folder that holds meta/ and data/."""
    mend: bool = False
    """Mend it; without, only say what is wrong. Nothing is ever deleted."""


def main(config: Config) -> None:
    """Print the problems, or what was done about them."""
    if config.mend:
        print("\n".join(repair(config.root)) or "nothing to mend")
        return
    problems = validate(config.root)
    if problems:
        shown = "\n  ".join(problems)
        raise UserError(f"{config.root} has {len(problems)} problem(s); --mend repairs:\n  {shown}")
    print(f"{config.root} is sound")

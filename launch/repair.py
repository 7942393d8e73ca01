"""Check a set of episodes; with --fix, make it sound again after an interruption or damage."""

from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import checked_dataclass


@checked_dataclass
class Config:
    """Options of repair."""

    root: Annotated[Path, tyro.conf.Positional]
    """The set: the folder that holds meta/ and data/, or the run folder around it."""
    fix: bool = False
    """Keep every whole episode and move what is damaged into FOLDER/repaired (nothing is deleted).
    Without --fix, only say what is wrong."""


def main(config: Config) -> None:
    """Print the problems, or what was done about them."""
    from touchgoal.episodes.repair import repair, validate

    if config.fix:
        print("\n".join(repair(config.root)) or f"{config.root} is sound: nothing to do")
        return
    problems = validate(config.root)
    if problems:
        shown = "\n  ".join(problems)
        raise UserError(
            f"{config.root} has {len(problems)} problem(s); --fix keeps every whole episode:\n  {shown}"
        )
    print(f"{config.root} is sound")

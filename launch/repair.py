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
    """Folder of the set, which holds meta/ and data/, or the run folder around it."""
    fix: bool = False
    """Rebuild the set from every whole episode and move damaged files to FOLDER/repaired; nothing is
    deleted. Without it, only print the problems."""


def main(config: Config) -> None:
    """Print the problems, or what was done about them."""
    from touchgoal.episodes.format.repair import repair

    if config.fix:
        print("\n".join(repair(config.root)) or f"{config.root} is sound: nothing to do")
    elif problems := _problems(config.root):
        shown = "\n  ".join(problems)
        raise UserError(
            f"{config.root} has {len(problems)} problem(s); --fix saves every whole episode of a set "
            f"that touchgoal wrote, others are read without their faulty ones:\n  {shown}"
        )
    else:
        print(f"{config.root} is sound")


def _problems(root: Path) -> list[str]:
    from touchgoal.episodes.faults import find_faults
    from touchgoal.episodes.format.foreign import ForeignSetError
    from touchgoal.episodes.format.repair import validate
    from touchgoal.episodes.store import EpisodeSet

    try:
        return validate(root)
    except ForeignSetError:
        episodes = EpisodeSet(root, complete=False)
        return list(find_faults(episodes, range(len(episodes))).values())

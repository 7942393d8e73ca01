"""Make a shipped policy anew, from its recordings to its weights, and say what was done.

Every step is a command of its own, printed before it runs; recipe.json beside the weights lists all of
them with their seeds, episodes and hours.
"""

import os
from pathlib import Path
from typing import Annotated, Any

from touchgoal.runtime.option_types import RARE, Count, CountOrNone, checked_dataclass
from touchgoal.sim_envs.config import TaskName


@checked_dataclass
class Config:
    """Options of make-policy."""

    task: TaskName = "pick-place"
    """Which policy."""
    out: Path | None = None
    """Folder of the run; the policy goes to its `policy/policy`."""
    demonstrations: Count | None = None
    """Episodes of the expert; default: 240 for pick-place, 160 for the maze."""
    corrections: Count | None = None
    """Episodes of each round in which the policy acts and the expert answers; default: 200 for
    pick-place, 80 for the maze."""
    rounds: CountOrNone = 5
    """Rounds of corrections, at most five for pick-place, whose third is in the plain environment, and
    three for the maze."""
    epochs: Count | None = None
    """Passes over the data in each training; default: 16 for pick-place, 5 for the maze."""
    trials: CountOrNone = 24
    """Validation episodes in which every snapshot of the last training is tried; 0 keeps the last."""
    touch: Annotated[Path | None, RARE] = None
    """Run folder of a new touch encoder (the maze), or of a state estimator (pick-place), in place of the
    shipped one: after the pads have changed."""
    learn_touch: bool = False
    """The maze: first learn a touch encoder from the demonstrations, without labels; after the pads have
    changed. Otherwise it feels with the shipped one."""
    resume: bool = False
    """Go on with an interrupted run in `out`."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""


def main(config: Any) -> None:
    """Record, train, correct, train again, choose."""
    from touchgoal.launch.commands.make_policy import run_command

    run_command(config)

"""Run a policy or the expert on the arm that a cell file names, with safety and recording.

A dry run unless --execute is given: everything is read, checked and planned, nothing is commanded.

Exit status: 0 the task is done, or nobody can tell, or a dry run; 1 something is missing or wrong, and
nothing moved, or the episode could not be kept; 3 the task is not done, or time was up; 4 the arm was
stopped, by a fault or the operator.
"""

from pathlib import Path
from typing import Annotated, Any

import tyro

from touchgoal.runtime.option_types import Seed, checked_dataclass


@checked_dataclass
class Config:
    """Options of deploy."""

    cell: Annotated[Path, tyro.conf.Positional]
    """Cell file: your own (.toml), the cell.json of a twin, or a shipped example by name, such as sim."""
    policy: str = ""
    """Who acts, in place of the cell file's: expert, follower, shipped, a folder that train-policy
    made, or a class of your own as module:Class or file.py:Class."""
    execute: bool = False
    """Move the arm. Without it this is a dry run."""
    yes: bool = False
    """Do not ask for the typed confirmation (for tests)."""
    sim: bool = False
    """Use a simulated arm in place of the cell file's."""
    seed: Seed | None = None
    """Random seed of the scene, in place of the cell file's (simulated arm or twin only)."""
    out: Path | None = None
    """Folder of the run; the episode goes to its `episodes/`, after those already there."""


def main(config: Any) -> None:
    """Check, connect, ask, run, record, report; the exit status says how it ended."""
    from touchgoal.launch.commands.deploy import run_command

    run_command(config)

"""Run a policy in a task and say how often it succeeds, with a 95 % Wilson interval."""

import os
from pathlib import Path
from typing import Any

from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig, TaskName

ENVS: dict[TaskName, TaskConfig] = {
    "pick-place": PickPlaceConfig(),
    "bead-maze": BeadMazeConfig(split="validation"),
}
"""Options of the environment of each task, unless others are typed."""


@checked_dataclass
class Config:
    """Options of run-policy."""

    task: TaskName = "pick-place"
    """Task to run it in."""
    policy: str = "shipped"
    """Which policy: shipped; a folder that train-policy made; expert, which sees the simulator's
    state; follower (bead-maze), the classical one, which feels the force on the hand; or a class of
    your own, as module:Class or file.py:Class (docs/own_policy.md)."""
    out: Path | None = None
    """Folder of the run."""
    episodes: Count = 20
    """Number of episodes; objects are taken in turn, wires one each."""
    seed: Seed = seeds.EVALUATION.start
    """Random seed of the first episode; each further one adds one."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""
    video: bool = True
    """Film the worst, the median and the best episode."""
    env: PickPlaceConfig | BeadMazeConfig = ENVS["pick-place"]
    """Options of the task; what the policy does not look at is not rendered."""


def main(config: Any) -> None:
    """Run the episodes, print the table, film three of them."""
    from touchgoal.launch.commands.run_policy import run_command

    run_command(config)

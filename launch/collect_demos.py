"""Record an expert's episodes of a task, or failures on purpose, as a LeRobot-v3 data set."""

import os
from pathlib import Path
from typing import Any

from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import (
    BeadMazeConfig,
    Outcome,
    PickPlaceConfig,
    TaskConfig,
    TaskName,
)

ENVS: dict[TaskName, TaskConfig] = {
    "pick-place": PickPlaceConfig(),
    "bead-maze": BeadMazeConfig(disturbance=0.004),  # shows how to come back
}
"""Options of the environment of each task, unless others are typed."""


@checked_dataclass
class Config:
    """Options of collect-demos."""

    task: TaskName = "pick-place"
    """Task that is demonstrated."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`, after those already there."""
    episodes: Count = 10
    """Number of episodes of each outcome."""
    outcomes: tuple[Outcome, ...] = ("success",)
    """What the expert shall do: succeed, or (pick-place) fail in one of four ways."""
    feedback: bool = False
    """pick-place: the expert decides anew at every tick instead of following a planned path; a policy
    learns better from that."""
    policy: str | None = None
    """A policy that acts in the expert's place, while what the expert would have done is recorded
    (DAgger): named as for run-policy."""
    seed: Seed = 0
    """Random seed of the first episode; each further one adds one."""
    resume: bool = False
    """Go on with an interrupted recording in `out`: leave out the seeds that it holds already."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""
    env: PickPlaceConfig | BeadMazeConfig = ENVS["pick-place"]
    """Options of the task; its objects or wires are taken in turn."""


def main(config: Any) -> None:
    """Record the episodes and say what came of them."""
    from touchgoal.launch.commands.collect_demos import run_command

    run_command(config)

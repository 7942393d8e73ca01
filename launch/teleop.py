"""Lead the bead along the wire with keys, and record it as an episode like any other demonstration.

The arm is compliant: a key pushes the hand, and the wire guides it. Ctrl-C ends; what was finished is
on disk.
"""

from dataclasses import field
from pathlib import Path
from typing import Any, Literal

from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import BeadMazeConfig, TeleoperatorConfig


@checked_dataclass
class Config:
    """Options of teleop."""

    task: Literal["bead-maze"] = "bead-maze"
    """Which task is demonstrated."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`, after those already there."""
    episodes: Count = 1
    """Number of attempts to lead the bead along a wire; those given up count."""
    seed: Seed = 0
    """Random seed of the first episode; each further one adds one."""
    hand: TeleoperatorConfig = field(default_factory=TeleoperatorConfig)
    """How hand and keys respond."""
    env: BeadMazeConfig = BeadMazeConfig(max_seconds=300.0, stall_seconds=60.0)
    """Options of the task; a person is given time to think. The straightest of the first wires is
    arc-2000009."""


def main(config: Any) -> None:
    """Offer the wires one by one, keep what is finished, say what came of it."""
    from touchgoal.launch.commands.teleop import run_command

    run_command(config)

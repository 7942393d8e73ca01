"""Serve the simulated cell over the robot's and the sensors' own wire protocols.

Any libfranka or RTDE client, any MJPEG reader and any serial client can drive it. It runs until
Ctrl-C; where everything is stands in a table and in `cell.json`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Seed, checked_dataclass
from touchgoal.sim_envs.config import (
    STREAM_SIZE,
    BeadMazeConfig,
    PickPlaceConfig,
    TaskConfig,
    TaskName,
)

ENVS: dict[TaskName, TaskConfig] = {
    "pick-place": PickPlaceConfig(camera_size=STREAM_SIZE),
    "bead-maze": BeadMazeConfig(
        cameras=("front", "wrist"), camera_size=STREAM_SIZE, split="validation", n_wires=20
    ),
}


@checked_dataclass
class Config:
    """Options of twin."""

    task: TaskName = "pick-place"
    """Which task the cell is set up for."""
    arm: Literal["fr3", "ur5e"] = "fr3"
    """An FR3 with the Franka Hand, or a UR5e whose gripper talks as a Robotiq does."""
    lock_step: bool = False
    """Wait for the client that drives the arm, so that runs repeat (for tests)."""
    wrench_error: bool = True
    """The arm's estimate of force has noise, bias and drift, as a real arm's."""
    host: str = "127.0.0.1"
    """Loopback address; twins at different ones run side by side."""
    port: Annotated[int, Field(ge=0, le=65534)] = 8080
    """TCP port of the pictures; the next one is the control port. 0: any that are free."""
    seed: Seed = seeds.EVALUATION.start
    """Random seed of the scene."""
    out: Path | None = None
    """Folder of the run: cell.json, serial devices."""
    env: TaskConfig = ENVS["pick-place"]
    """Options of the task."""


def main(config: Any) -> None:
    """Open the twin, say where it is, serve until told to stop."""
    from touchgoal.launch.commands.twin import run_command

    run_command(config)

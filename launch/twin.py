"""Serve the simulated cell over the robot's and the sensors' own wire protocols.

Any libfranka or RTDE client, any MJPEG reader and any serial client can drive it. It runs until
Ctrl-C; where everything is stands in a table and in `cell.json`.
"""

import signal
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from touchgoal.control.cell.cell_file import cell_table
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.option_types import Seed, checked_dataclass
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.sim_envs.config import (
    STREAM_SIZE,
    BeadMazeConfig,
    PickPlaceConfig,
    TaskConfig,
    TaskName,
)
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig

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
    host: str = "127.0.0.1"
    """Loopback address; twins at different ones run side by side."""
    port: Annotated[int, Field(ge=0, le=65534)] = 8080
    """TCP port of the pictures; the next one is the control port. 0: any that are free."""
    seed: Seed = 1_000_000
    """Random seed of the scene."""
    out: Path | None = None
    """Folder of the run: cell.json, serial devices."""
    env: TaskConfig = ENVS["pick-place"]
    """Options of the task."""


def main(config: Config) -> None:
    """Open the twin, say where it is, serve until told to stop."""
    out = open_run(config.out, "twin", config, adds=True).resolve()
    twin = Twin(
        TwinConfig(
            task=config.env,
            arm=config.arm,
            seed=config.seed,
            host=config.host,
            port=config.port,
            lock_step=config.lock_step,
            folder=out,
        )
    )

    def stop(*_: object) -> None:
        twin.stopped = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    cell_file = out / "cell.json"
    write_json(cell_file, cell_table(twin.cell_config))
    print(
        f"{table(twin.cell_config)}\n{'cell file':<18}{cell_file}\n"
        f"The cell runs. In another terminal: touchgoal deploy {cell_file} --execute\n"
        "Each deployment first puts the scene back. Ctrl-C ends the twin.",
        flush=True,
    )
    try:
        twin.run()
    finally:
        twin.close()
    print("\nstopped")


def table(cell: CellConfig) -> str:
    """Where everything is."""
    assert cell.load_cell is not None
    lines = {"task": cell.task.instruction, f"arm ({cell.arm})": cell.address}
    lines["gripper"] = cell.gripper.port or cell.gripper.address
    lines |= {name: camera.source for name, camera in cell.cameras.items()}
    if cell.fingertips is not None:
        lines |= {"left fingertip": cell.fingertips.left, "right fingertip": cell.fingertips.right}
    lines |= {"load cell": cell.load_cell.port, "control port": cell.task.twin}
    return "\n".join(f"{name:<18}{where}" for name, where in lines.items())

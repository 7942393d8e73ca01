"""Serve the simulated cell over the robot's and the sensors' own wire protocols.

Any libfranka or RTDE client, any MJPEG reader and any serial client can drive it. It runs until
Ctrl-C; where everything is stands in a table and in `cell.json`.
"""

import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.sim_envs.config import STREAM_SIZE, BeadMazeConfig, PickPlaceConfig
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig


@dataclass(frozen=True)
class Config:
    """Options of twin."""

    task: Literal["pick-place", "bead-maze"] = "pick-place"
    """What the cell is for."""
    arm: Literal["fr3", "ur5e"] = "fr3"
    """An FR3 with the Franka Hand, or a UR5e whose gripper talks as a Robotiq does."""
    lock_step: bool = False
    """Wait for the client that drives the arm, so that runs repeat (for tests)."""
    host: str = "127.0.0.1"
    """Loopback address; twins at different ones run side by side."""
    port: int = 8080
    """Of the pictures; the next one is for faults. 0: any that are free."""
    seed: int = 1_000_000
    """Of the first episode."""
    object: str = ""
    """pick-place: what to pick up; default: drawn from the catalogue."""
    wire: str = ""
    """bead-maze: which wire, such as helix-1; default: drawn."""
    out: Path | None = None
    """Folder of the run: cell.json, serial devices."""
    env: PickPlaceConfig = field(default_factory=lambda: PickPlaceConfig(camera_size=STREAM_SIZE))
    """Options of pick-place."""
    maze: BeadMazeConfig = field(
        default_factory=lambda: BeadMazeConfig(
            cameras=("front", "wrist"), camera_size=STREAM_SIZE, split="validation", n_wires=20
        )
    )
    """Options of bead-maze."""


def main(config: Config) -> None:
    """Open the twin, say where it is, serve until told to stop."""
    maze = config.task == "bead-maze"
    chosen = {"wire": config.wire} if maze else {"object": config.object}
    out = open_run(config.out, "twin", config).resolve()
    twin = Twin(
        TwinConfig(
            task=config.maze if maze else config.env,
            arm=config.arm,
            seed=config.seed,
            options={name: value for name, value in chosen.items() if value},
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
    write_json(out / "cell.json", twin.description)
    print(
        table(twin.description) + f"\n{'cell file':<18}{out / 'cell.json'}\nCtrl-C ends it.",
        flush=True,
    )
    try:
        twin.run()
    finally:
        twin.close()
    print("\nstopped")


def table(cell: dict) -> str:
    """Where everything is."""
    lines = {"task": cell["instruction"], f"arm ({cell['arm']})": cell["address"]}
    lines["gripper"] = cell["gripper"].get("port") or cell["gripper"]["address"]
    lines |= {key.rpartition(".")[2]: address for key, address in cell["images"].items()}
    lines |= {"load cell": cell["load_cell"]["port"], "faults": cell["faults"]}
    return "\n".join(f"{name:<18}{where}" for name, where in lines.items())

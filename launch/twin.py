"""Serve the simulated cell over the robot's and the sensors' own wire protocols.

Any libfranka or RTDE client, any MJPEG reader and any serial client can drive it. It runs until
Ctrl-C, or until the program that started it ends, unless that is a terminal or nohup; a table and
`cell.json` list every address.
"""

import ipaddress
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from touchgoal.control.cell.config import CellConfig, SimulatedTask
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Seed, checked_dataclass
from touchgoal.sim_envs.config import STREAM_SIZE, BeadMazeConfig, PickPlaceConfig, TaskConfig

_PARENT = os.getppid()  # as the command begins: loading takes seconds
ENVS: dict[SimulatedTask, TaskConfig] = {
    "pick-place": PickPlaceConfig(camera_size=STREAM_SIZE),
    "bead-maze": BeadMazeConfig(
        cameras=("front", "wrist"), camera_size=STREAM_SIZE, split="validation", n_wires=20
    ),
}


@checked_dataclass
class Config:
    """Options of twin."""

    task: SimulatedTask = "pick-place"
    """Task that the cell is set up for."""
    arm: Literal["fr3", "ur5e"] = "fr3"
    """FR3 with the Franka Hand, or UR5e with a Robotiq gripper."""
    lock_step: bool = False
    """Wait for the client that drives an FR3, so that runs repeat (for tests)."""
    wrench_error: bool = True
    """Give the arm's force estimate noise, bias and drift, as on a real arm."""
    host: str = "127.0.0.1"
    """Address to serve at; twins at different loopback addresses run side by side. At any other address
    the whole network can drive this twin and see its images."""
    port: Annotated[int, Field(ge=0, le=65534)] = 8080
    """TCP port of the images; the next one is the control port. 0: any that are free."""
    seed: Seed = seeds.EVALUATION.start
    """Random seed of the scene."""
    out: Path | None = None
    """Folder of the run: cell.json, serial devices."""
    env: TaskConfig = ENVS["pick-place"]
    """Options of the task."""


def main(config: Config) -> None:
    """Open the twin, print its addresses, serve until a signal ends it."""
    from touchgoal.control.cell.cell_file import cell_table
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.run_folder import open_run
    from touchgoal.sim_envs.twin.serve import Twin, TwinConfig

    if config.lock_step and config.arm != "fr3":
        raise UserError("a UR's clients answer no states to wait for: leave out --lock-step")
    out = open_run(config.out, "twin", config, adds=True).resolve()
    served = config.host, config.port, config.lock_step, out, config.wrench_error
    twin = Twin(TwinConfig(config.env, config.arm, config.seed, *served))

    def stop(*_: object) -> None:
        twin.stopped = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    detached = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN  # by nohup
    if not detached and not any(map(os.isatty, range(3))):
        twin.parent = _PARENT
    cell_file = out / "cell.json"
    write_json(cell_file, cell_table(twin.cell_config))
    if warning := open_to_network(config.host):
        print(f"touchgoal twin: {warning}", file=sys.stderr)
    print(
        f"{_table(twin.cell_config)}\n{'cell file':<18}{cell_file}\n"
        f"The cell runs. In another terminal: touchgoal deploy {cell_file} --execute\n"
        "Each deployment first puts the scene back. Ctrl-C ends the twin.",
        flush=True,
    )
    try:
        twin.run()
    finally:
        twin.close()
    images = twin.images
    numbers: dict[str, float] = dict(twin.pace.summary())
    numbers |= {"pictures_taken": images.taken, "pictures_left_out": images.left_out}
    write_json(out / "metrics.json", numbers)
    print(f"\n{_pace(numbers)}\nstopped")


def open_to_network(host: str) -> str:
    """Return a warning if others than this computer can reach the host; empty for loopback."""
    try:
        if ipaddress.ip_address(host).is_loopback:
            return ""
    except ValueError:  # a name
        if host == "localhost":
            return ""
    return (
        f"--host {host} is open to the network: any computer there can drive this arm and see its "
        "images; only the control port asks for a token"
    )


def _table(cell: CellConfig) -> str:
    assert cell.load_cell is not None
    lines = {"task": cell.task.instruction, f"arm ({cell.arm})": cell.address}
    lines["gripper"] = cell.gripper.port or cell.gripper.address
    lines |= {name: camera.source for name, camera in cell.cameras.items()}
    if cell.fingertips is not None:
        lines |= {"left fingertip": cell.fingertips.left, "right fingertip": cell.fingertips.right}
    lines |= {"load cell": cell.load_cell.port, "control port": cell.task.twin}
    return "\n".join(f"{name:<18}{where}" for name, where in lines.items())


def _pace(numbers: dict[str, float]) -> str:
    if not numbers["seconds"]:
        return "no client drove the arm for a whole second: no pace to report"
    return (
        f"{numbers['seconds']} s with a client that drives the arm: simulated over wall time "
        f"{numbers['pace_median']:.2f} in the median second, {numbers['pace_slowest']:.2f} in the slowest\n"
        f"images left out to keep pace: {numbers['pictures_left_out']} of "
        f"{numbers['pictures_taken'] + numbers['pictures_left_out']}\n"
        f"processor time a simulated second: {numbers['processor_twin']:.2f} s, and "
        f"{numbers['processor_pictures']:.2f} s for images"
    )

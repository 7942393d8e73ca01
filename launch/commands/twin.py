"""What `touchgoal twin` does."""

import signal

from touchgoal.control.cell.cell_file import cell_table
from touchgoal.control.cell.config import CellConfig
from touchgoal.launch.twin import Config
from touchgoal.runtime.run_folder import open_run, write_json
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig


def run_command(config: Config) -> None:
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
            wrench_error=config.wrench_error,
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
    numbers: dict[str, float] = {
        **twin.pace.summary(),
        "pictures_taken": twin.pictures.taken,
        "pictures_left_out": twin.pictures.left_out,
    }
    write_json(out / "metrics.json", numbers)
    print("\n" + "\n".join(_pace_lines(numbers)) + "stopped")


def _pace_lines(numbers: dict[str, float]) -> list[str]:
    """What a person is told of the twin's pace."""
    if not numbers["seconds"]:
        return [""]
    return [
        f"{numbers['seconds']} s with a client that drives the arm: simulated over wall time "
        f"{numbers['pace_median']:.2f} in the median second, {numbers['pace_slowest']:.2f} in the slowest",
        f"pictures left out to keep pace: {numbers['pictures_left_out']} of "
        f"{numbers['pictures_taken'] + numbers['pictures_left_out']}",
        f"processor time a simulated second: {numbers['processor_twin']:.2f} s, and "
        f"{numbers['processor_pictures']:.2f} s for pictures",
        "",
    ]


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

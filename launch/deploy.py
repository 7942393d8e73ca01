"""Run a policy or the expert on the arm that a cell file names, with safety and recording.

A dry run unless --execute is given: everything is read, checked and planned, nothing is commanded.

Exit status: 0 the task is done, or its outcome is unknown, or a dry run; 1 something is missing or wrong, and
nothing moved, or the episode could not be saved; 3 the task is not done, or time was up; 4 the arm was
stopped, by a fault or the operator.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from touchgoal.control.cell.config import CellConfig
from touchgoal.control.interfaces import Planner
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Seed, checked_dataclass
from touchgoal.runtime.viewer.stream import RerunStream

if TYPE_CHECKING:
    from touchgoal.control.cell.connection import CellConnection
    from touchgoal.control.deployment.control_loop import TickStatus
    from touchgoal.control.deployment.session import Result

NOT_DONE, STOPPED = 3, 4  # exit status


@checked_dataclass
class Config:
    """Options of deploy."""

    cell: Annotated[Path, tyro.conf.Positional]
    """Cell file: your own (.toml), the cell.json of a twin, or a shipped example by name, such as sim."""
    policy: str = ""
    """Policy in place of the cell file's: expert, follower, shipped, a folder that train-policy made, a
    class of your own as module:Class or file.py:Class, whose code then runs, or an openpi server as
    ws://host:port."""
    target: str | None = None
    """Object to pick up where several lie on the table, in words, such as "the red block"; in place
    of the cell file's."""
    execute: bool = False
    """Move the arm. Without it this is a dry run."""
    yes: bool = False
    """Do not ask for a touch of each fingertip and the typed confirmation (for tests)."""
    sim: bool = False
    """Use a simulated arm in place of the cell file's."""
    seed: Seed | None = None
    """Random seed of the scene, in place of the cell file's (simulated arm or twin only)."""
    task: str = ""
    """Name of a task of your own, in place of the cell file's."""
    rerun: str | None = None
    """Also show every tick in the rerun viewer (extra viz): live, or an .rrd file to write."""
    out: Path | None = None
    """Folder of the run; the episode goes to its `episodes/`, after those already there."""


def main(config: Config) -> None:
    """Check, connect, ask, run, record, report; the exit status says how it ended."""
    from touchgoal.control.cell.cell_file import find_cell_file, read_cell_file
    from touchgoal.control.deployment.preflight import check_client
    from touchgoal.launch.support.cell_run import connect
    from touchgoal.runtime.run_folder import open_run

    file = find_cell_file(config.cell)
    cell = read_cell_file(file, config.policy, config.sim, config.seed, config.task, config.target)
    policy, camera_size = load_policy(cell)
    cost = None
    if cell.task.rewards or cell.task.judge:
        from touchgoal.rewards.online import load_cell_cost

        cost = load_cell_cost(cell)
    check_client(cell)
    out = open_run(config.out, "deploy", config, adds=True)
    print(_summary(cell, config), flush=True)
    stream = RerunStream(config.rerun) if config.rerun is not None else None
    try:
        connection = connect(cell)
        try:
            loaded = policy, camera_size, cost
            result = _deploy(config, cell, *loaded, connection, out / "episodes", stream)
        finally:
            connection.close()
            if cost is not None:
                cost.close()
    finally:
        if stream is not None and (problem := stream.close()):
            print(problem, file=sys.stderr)
    _report(result, out)


def load_policy(cell: CellConfig) -> tuple[Planner | None, tuple[int, int]]:
    """Return the cell's policy, None for a script, and the size of the camera images that it reads.

    UserError: the policy does not fit the cell.
    """
    from touchgoal.control.deployment.actors import SCRIPTED, check_sensors
    from touchgoal.control.deployment.user_policy import find_user_policy
    from touchgoal.sim_envs.twin.cell_task import env_config_of

    name, target, options = cell.task.policy, cell.task.target, env_config_of(cell)
    if not name:
        raise UserError("task.policy is missing: name one in the cell file, or by --policy")
    make = find_user_policy(name, cell.task.instruction)
    if target is not None and (make or name in SCRIPTED):
        raise UserError(f"the policy {name} takes no target: leave it out")
    if name in SCRIPTED:
        return None, options.camera_size
    if make:
        policy = make()
        policy.reset()
        options = policy.env_config(options)
    else:
        from touchgoal.policies.checkpoint import EPISODE_OBJECT, SavedPolicy, find_policy

        if target is not None and EPISODE_OBJECT in target:
            raise UserError(
                f"{EPISODE_OBJECT} is known in run-policy alone: name the object itself"
            )
        folder = find_policy(name, cell.task.simulated)
        policy = SavedPolicy(folder, front_camera=options.front_camera).with_target(target)()
        options = policy.env_config(options, cell.task.name)
    check_sensors(cell, options.tactile, options.cameras)
    return policy, options.camera_size


def _summary(cell: CellConfig, config: Config) -> str:
    where = "a simulated FR3 in this program" if cell.arm == "sim" else f"{cell.arm} {cell.address}"
    moves = "it moves" if config.execute else "a dry run, nothing moves"
    return f"{cell.task.name} by {cell.task.policy} on {where}, {cell.task.seconds:g} s at most: {moves}"


def _deploy(
    config: Config,
    cell: CellConfig,
    policy: Planner | None,
    camera_size: tuple[int, int],
    cost: Any,
    connection: "CellConnection",
    episodes: Path,
    stream: RerunStream | None,
) -> "Result":
    from touchgoal.control.deployment.actors import make_actor
    from touchgoal.control.deployment.session import Session
    from touchgoal.control.deployment.terminal import HELP, Terminal
    from touchgoal.control.features import CONTROL_HZ
    from touchgoal.episodes.episode_recorder import EpisodeRecorder
    from touchgoal.launch.support.cell_run import check_cell, confirm

    def on_tick(status: "TickStatus") -> None:
        terminal.show_tick(status)
        if log is not None:
            log(status)

    safety = check_cell(cell, connection, episodes)
    if config.execute and not config.yes:
        confirm(cell, connection)
    terminal = Terminal()
    log = _shown_in(stream, safety.dt) if stream is not None else None
    session = Session(
        cell=cell,
        connection=connection,
        safety=safety,
        recorder=EpisodeRecorder(episodes, CONTROL_HZ),
        execute=config.execute,
        make_actor=lambda loop: make_actor(cell, policy, safety, connection.truth, loop.commanded),
        operator_request=terminal.operator_request,
        on_tick=on_tick,
        cost=cost,
        camera_size=camera_size,
        ask=terminal.ask,
    )
    with terminal.watching():
        print(f"{'MOVING' if config.execute else 'dry run'}: {HELP}", flush=True)
        return session.run()


def _shown_in(stream: RerunStream, dt: float) -> "Callable[[TickStatus], None]":
    """Return what logs a tick of `dt` (s): images, and curves of force, hand, command and cost."""
    import numpy as np

    from touchgoal.control import features as ft

    def show(status: "TickStatus") -> None:
        seen = status.reading.observation
        images = {
            key.removeprefix(ft.IMAGE_PREFIX): image
            for key, image in seen.items()
            if key.startswith(ft.IMAGE_PREFIX)
        }
        curves = {"cost/cost": status.cost.cost} if status.cost is not None else {}
        curves |= {
            "force (N)/force": float(np.linalg.norm(seen[ft.WRENCH][:3])),
            "gripper width (mm)/measured": 1e3 * seen[ft.STATE][-1],
            "gripper width (mm)/commanded": 1e3 * status.width,
        }
        changes = enumerate(status.state.velocity * dt, 1)
        curves |= {f"joint change (rad)/joint_{i}": change for i, change in changes}
        for key, depth in zip(ft.TACTILE, status.reading.indentation, strict=True):
            if key in seen:
                curves[f"indentation (mm)/{key.removeprefix(ft.IMAGE_PREFIX)}"] = 1e3 * depth
        stream.log(status.seconds, images, {path: float(value) for path, value in curves.items()})

    return show


def _report(result: "Result", out: Path) -> None:
    from touchgoal.control.deployment.session import metrics, report
    from touchgoal.control.deployment.terminal import say
    from touchgoal.runtime.json_file import write_json

    numbers, lost = metrics(result), [result.recording_error] if result.recording_error else []
    try:
        write_json(out / "metrics.json", numbers)
    except OSError as error:  # the table is printed all the same
        lost.append(f"metrics.json could not be written ({error.strerror}): make room on the disk")
    say(report(result, numbers, str(out / "episodes")))
    if result.ending.stopped:
        say(f"for a bug report: touchgoal report {out}")
        line = "; ".join([f"touchgoal deploy: stopped: {result.ending.reason}", *lost])
        print(line, file=sys.stderr)
        sys.exit(STOPPED)
    if lost:
        raise UserError("; ".join(lost))
    if result.success is False:
        print("touchgoal deploy: the task is not done", file=sys.stderr)
        sys.exit(NOT_DONE)

"""Run a policy or the expert on the arm that a cell file names, with safety and recording.

A dry run unless --execute is given: everything is read, checked and planned, nothing is commanded.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig, read_cell_file
from touchgoal.control.cell.connection import CellConnection, cell_watchdogs, connect_cell
from touchgoal.control.checks import require_all_ok
from touchgoal.control.errors import UserError
from touchgoal.control.interfaces import DriverError
from touchgoal.control.safety.action_filter import Safety
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.encoders import pretrained
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.launch.terminal import HELP, Terminal
from touchgoal.policies.deploy.actors import load_policy, make_actor
from touchgoal.policies.deploy.preflight import preflight
from touchgoal.policies.deploy.session import Result, Session
from touchgoal.rewards.curves import DistanceNormalizer
from touchgoal.rewards.goals import parse_goal
from touchgoal.rewards.online import OnlineCost
from touchgoal.sim_envs.config import EnvConfig
from touchgoal.sim_envs.twin.faults import ask_twin
from touchgoal.sim_envs.twin.in_process import simulate_cell

_ASKING = 0.2  # s between questions to a twin


@dataclass(frozen=True)
class Config:
    """Options of deploy."""

    cell: Annotated[Path, tyro.conf.Positional]
    """The cell file: one like those in launch/cells/, or the cell.json of a twin."""
    policy: str = ""
    """In place of the cell's: expert, follower, shipped, or a folder that train-policy made."""
    execute: bool = False
    """Move the arm. Without it this is a dry run."""
    yes: bool = False
    """Do not ask for the typed confirmation (for tests)."""
    sim: bool = False
    """Put a simulated arm in place of the cell's, as `arm = "sim"` in the file does."""
    out: Path | None = None
    """Folder of the run; the episode goes to its `episodes/`, after those already there."""


def main(config: Config) -> None:
    """Connect, check, ask, run, record, report; UserError, so exit code 1, if it was stopped."""
    cell = read_cell_file(config.cell, config.policy)
    if config.sim:
        cell = replace(cell, arm="sim")
    out = open_run(config.out, "deploy", config)
    try:
        connection = (
            simulate_cell(cell, ft.CONTROL_HZ)
            if cell.arm == "sim"
            else connect_cell(cell, ft.CONTROL_HZ)
        )
    except DriverError as error:
        raise UserError(str(error)) from error
    try:
        result = _deploy(config, cell, connection, out)
    finally:
        connection.close()
    _report(result, out)


def _deploy(config: Config, cell: CellConfig, connection: CellConnection, out: Path) -> Result:
    safety = Safety(connection.robot, ft.CONTROL_HZ, cell_watchdogs(cell))
    results = preflight(cell, connection, safety, out / "episodes")
    print("\n".join(str(f) for f in results), flush=True)
    require_all_ok(results)
    if config.execute and not config.yes:
        _confirm(cell)
    maker, terminal, cost = load_policy(cell), Terminal(), _cost(cell)
    truth = connection.truth or (
        partial(ask_twin, cell.task.twin, "truth") if cell.task.twin else None
    )
    # Scripts end by themselves; of others only a simulator knows when the task is done.
    endless = cell.task.policy != "expert"
    judge = LatestValue("judge", partial(_done, truth)) if endless and truth else None
    print(f"{'MOVING' if config.execute else 'dry run'}: {HELP}", flush=True)
    with terminal.watching():
        session = Session(
            cell=cell,
            connection=connection,
            safety=safety,
            episodes=out / "episodes",
            execute=config.execute,
            make_actor=lambda d: make_actor(cell, maker, safety, truth, d.commanded),
            operator_request=terminal.operator_request
            if judge is None
            else lambda: terminal.operator_request() or judge.read(),
            on_tick=terminal.show_tick,
            truth=truth,
            cost=cost.latest_cost if cost else None,
            camera_size=(maker.env_config(EnvConfig()) if maker else EnvConfig()).camera_size,
        )
        try:
            return session.run()
        finally:
            if cost is not None:
                cost.close()
            if judge is not None:
                judge.close()


def _cost(cell: CellConfig) -> OnlineCost | None:
    """What measures the distance to the cell's goals, on the shipped encoder."""
    if not cell.task.rewards:
        return None
    directory = pretrained.shipped_encoder_for(cell.sensor)
    encoder = pretrained.load_aligned(directory, sensor=cell.sensor)
    scale = DistanceNormalizer.load(directory / "scale.json")
    goals = [parse_goal(text) for text in cell.task.rewards]
    return OnlineCost(load_towers(encoder.config.towers), encoder, scale, goals)


def _done(truth: Callable[[], dict[str, Any]]) -> str:
    """What a simulator wants: "done" once the task is."""
    time.sleep(_ASKING)
    return "done" if truth()["success"] else ""


def _confirm(cell: CellConfig) -> None:
    """UserError unless the operator types which arm is to move."""
    name = f"{cell.arm} {cell.address}".strip()
    if not sys.stdin.isatty():
        raise UserError("nobody is there to confirm: run it in a terminal, or add --yes")
    print(f"The arm will move. One hand on its stop, nobody in reach? Type: {name}")
    if input("> ").strip() != name:
        raise UserError("not confirmed; nothing has moved")


def _report(result: Result, out: Path) -> None:
    ending, log = result.ending, result.log
    late = np.array(log.lateness) if log.lateness else np.zeros(1)
    forces = [np.linalg.norm(row[ft.WRENCH][:3]) for row in log.rows]
    numbers = {
        "reason": ending.reason,
        "stopped": ending.stopped,
        "advice": ending.advice,
        "rest_seconds": ending.rest_seconds,
        "success": result.success,
        "episode": result.episode,
        "recording_error": result.recording_error,
        "ticks": len(log.rows),
        "late_p99_ms": 1e3 * float(np.percentile(late, 99)),
        "answered_p95_ms": 1e3 * float(np.percentile(log.answer_times or [0.0], 95)),
        "force_max_newtons": float(max(forces, default=0.0)),
        "clamped": log.limit_counts,
    }
    write_json(out / "metrics.json", numbers)
    clamped = ", ".join(f"{name} {n}" for name, n in log.limit_counts.items()) or "never"
    print(f"{len(log.rows)} ticks, late by {numbers['late_p99_ms']:.1f} ms at most in 99 %, "
          f"answered in {numbers['answered_p95_ms']:.1f} ms at most in 95 %; "
          f"clamped: {clamped}; force up to {numbers['force_max_newtons']:.1f} N")  # fmt: skip
    if result.success is not None:
        print(f"task (as the simulator judges): {'done' if result.success else 'not done'}")
    if result.episode is not None:
        print(f"episode {result.episode} in {out / 'episodes'}")
    if result.recording_error:
        print(result.recording_error)
    print(ending if ending.stopped else f"ended: {ending}")
    if ending.stopped or result.recording_error:
        raise UserError((result.recording_error or ending.reason).splitlines()[0])

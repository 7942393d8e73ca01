"""Run a policy or the expert on the arm that a rig file names, with safety and recording.

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
from touchgoal.control.cell.config import Rig, read_rig
from touchgoal.control.cell.connection import Station, open_station, watchdogs_of
from touchgoal.control.checks import require
from touchgoal.control.errors import UserError
from touchgoal.control.interfaces import DriverError
from touchgoal.control.safety.action_filter import Safety
from touchgoal.control.sensors.latest_value import Newest
from touchgoal.encoders import pretrained
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.launch.terminal import HELP, Terminal
from touchgoal.policies.deploy.actors import learned, make_actor
from touchgoal.policies.deploy.preflight import preflight
from touchgoal.policies.deploy.session import Result, Session
from touchgoal.rewards.curves import Scale
from touchgoal.rewards.goals import parse_goal
from touchgoal.rewards.online import LiveCost
from touchgoal.sim_envs.base import EnvConfig
from touchgoal.sim_envs.twin.faults import ask
from touchgoal.sim_envs.twin.in_process import simulate

_ASKING = 0.2  # s between questions to a twin


@dataclass(frozen=True)
class Config:
    """Options of deploy."""

    rig: Annotated[Path, tyro.conf.Positional]
    """The rig file: one like those in launch/cells/, or the rig.json of a twin."""
    policy: str = ""
    """In place of the rig's: expert, follower, shipped, or a folder that train-policy made."""
    execute: bool = False
    """Move the arm. Without it this is a dry run."""
    yes: bool = False
    """Do not ask for the typed confirmation (for tests)."""
    sim: bool = False
    """Put a simulated arm in place of the rig's, as `arm = "sim"` in the file does."""
    out: Path | None = None
    """Folder of the run; the episode goes to its `episodes/`, after those already there."""


def main(config: Config) -> None:
    """Connect, check, ask, run, record, report; UserError, so exit code 1, if it was stopped."""
    rig = read_rig(config.rig, config.policy)
    if config.sim:
        rig = replace(rig, arm="sim")
    out = open_run(config.out, "deploy", config)
    try:
        station = (
            simulate(rig, ft.CONTROL_HZ) if rig.arm == "sim" else open_station(rig, ft.CONTROL_HZ)
        )
    except DriverError as error:
        raise UserError(str(error)) from error
    try:
        result = _deploy(config, rig, station, out)
    finally:
        station.close()
    _report(result, out)


def _deploy(config: Config, rig: Rig, station: Station, out: Path) -> Result:
    safety = Safety(station.robot, ft.CONTROL_HZ, watchdogs_of(rig))
    findings = preflight(rig, station, safety, out / "episodes")
    print("\n".join(str(f) for f in findings), flush=True)
    require(findings)
    if config.execute and not config.yes:
        _confirm(rig)
    maker, terminal, cost = learned(rig), Terminal(), _cost(rig)
    truth = station.truth or (partial(ask, rig.task.twin, "truth") if rig.task.twin else None)
    # Scripts end by themselves; of others only a simulator knows when the task is done.
    endless = rig.task.policy != "expert"
    judge = Newest("judge", partial(_done, truth)) if endless and truth else None
    print(f"{'MOVING' if config.execute else 'dry run'}: {HELP}", flush=True)
    with terminal.watching():
        session = Session(
            rig=rig,
            station=station,
            safety=safety,
            episodes=out / "episodes",
            execute=config.execute,
            make=lambda d: make_actor(rig, maker, safety, truth, d.commanded),
            wanted=terminal.wanted if judge is None else lambda: terminal.wanted() or judge.read(),
            show=terminal.show,
            truth=truth,
            cost=cost.look if cost else None,
            camera_size=(maker.observing(EnvConfig()) if maker else EnvConfig()).camera_size,
        )
        try:
            return session.run()
        finally:
            if cost is not None:
                cost.close()
            if judge is not None:
                judge.close()


def _cost(rig: Rig) -> LiveCost | None:
    """What measures the distance to the rig's goals, on the shipped encoder."""
    if not rig.task.rewards:
        return None
    directory = pretrained.shipped_for(rig.sensor)
    encoder = pretrained.load(directory, sensor=rig.sensor)
    scale = Scale.load(directory / "scale.json")
    goals = [parse_goal(text) for text in rig.task.rewards]
    return LiveCost(load_towers(encoder.config.towers), encoder, scale, goals)


def _done(truth: Callable[[], dict[str, Any]]) -> str:
    """What a simulator wants: "done" once the task is."""
    time.sleep(_ASKING)
    return "done" if truth()["success"] else ""


def _confirm(rig: Rig) -> None:
    """UserError unless the operator types which arm is to move."""
    name = f"{rig.arm} {rig.address}".strip()
    if not sys.stdin.isatty():
        raise UserError("nobody is there to confirm: run it in a terminal, or add --yes")
    print(f"The arm will move. One hand on its stop, nobody in reach? Type: {name}")
    if input("> ").strip() != name:
        raise UserError("not confirmed; nothing has moved")


def _report(result: Result, out: Path) -> None:
    ending, ticks = result.ending, result.ticks
    late = np.array(ticks.late) if ticks.late else np.zeros(1)
    forces = [np.linalg.norm(row[ft.WRENCH][:3]) for row in ticks.rows]
    numbers = {
        "reason": ending.reason,
        "stopped": ending.stopped,
        "advice": ending.advice,
        "rest_seconds": ending.rest,
        "success": result.success,
        "episode": result.episode,
        "trouble": result.trouble,
        "ticks": len(ticks.rows),
        "late_p99_ms": 1e3 * float(np.percentile(late, 99)),
        "answered_p95_ms": 1e3 * float(np.percentile(ticks.answered or [0.0], 95)),
        "force_max_newtons": float(max(forces, default=0.0)),
        "clamped": ticks.acted,
    }
    write_json(out / "metrics.json", numbers)
    clamped = ", ".join(f"{name} {n}" for name, n in ticks.acted.items()) or "never"
    print(f"{len(ticks.rows)} ticks, late by {numbers['late_p99_ms']:.1f} ms at most in 99 %, "
          f"answered in {numbers['answered_p95_ms']:.1f} ms at most in 95 %; "
          f"clamped: {clamped}; force up to {numbers['force_max_newtons']:.1f} N")  # fmt: skip
    if result.success is not None:
        print(f"task (as the simulator judges): {'done' if result.success else 'not done'}")
    if result.episode is not None:
        print(f"episode {result.episode} in {out / 'episodes'}")
    if result.trouble:
        print(result.trouble)
    print(ending if ending.stopped else f"ended: {ending}")
    if ending.stopped or result.trouble:
        raise UserError((result.trouble or ending.reason).splitlines()[0])

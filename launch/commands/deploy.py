"""What `touchgoal deploy` does."""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection, cell_watchdogs, connect_cell
from touchgoal.control.deployment.actors import SCRIPTED, CellPolicy, load_user_policy, make_actor
from touchgoal.control.deployment.control_loop import SLOW_ARM, Request, slow_arm
from touchgoal.control.deployment.preflight import check_client, preflight
from touchgoal.control.deployment.session import Result, Session
from touchgoal.control.interfaces import DriverError
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.encoders import pretrained
from touchgoal.encoders.published import is_published
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.launch.deploy import Config
from touchgoal.launch.support.terminal import HELP, Terminal
from touchgoal.rewards.embedding_distance import check_words
from touchgoal.rewards.goals import parse_goal
from touchgoal.rewards.normalizer import NORMALIZER, DistanceNormalizer
from touchgoal.rewards.online import CostMeter, OnlineCost
from touchgoal.rewards.setup import own_towers
from touchgoal.runtime.checks import require_all_ok
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.run_folder import open_run, write_json
from touchgoal.sim_envs.cell.in_process import simulate_cell
from touchgoal.sim_envs.twin.cell_task import env_config_of
from touchgoal.sim_envs.twin.control_port import ask_twin, put_scene_back

EXAMPLES = Path(__file__).parents[2] / "control" / "cell" / "examples"


NOT_DONE, STOPPED = 3, 4  # exit status


_ASKING = 0.2  # s between questions to a twin


def run_command(config: Config) -> None:
    """Check, connect, ask, run, record, report; the exit status says how it ended."""
    cell = _read(config)
    policy, cost = load_policy(cell), _load_cost(cell)
    check_client(cell)
    try:
        out = open_run(config.out, "deploy", config, adds=True)
    except OSError as error:
        raise UserError(
            f"cannot write into the folder of this run ({error.strerror}): give another --out"
        ) from error
    print(_summary(cell, config), flush=True)
    if cell.task.twin and cell.arm != "sim":
        put_scene_back(cell.task.twin, cell.task.seed)
        print(f"the twin has put its scene back (seed {cell.task.seed})", flush=True)
    try:
        connection = _connect(cell)
    except DriverError as error:
        raise UserError(str(error)) from error
    try:
        result = _deploy(config, cell, policy, cost, connection, out)
    finally:
        connection.close()
        if cost is not None:
            cost.close()
    _report(result, out)


def load_policy(cell: CellConfig) -> CellPolicy | None:
    """Return the cell's policy, None for a scripted actor; UserError if it does not fit."""
    if cell.task.policy in SCRIPTED:
        return None
    options = env_config_of(cell)
    if (policy := load_user_policy(cell, options)) is not None:
        return policy
    from touchgoal.policies.deployed import load_saved_policy

    return load_saved_policy(cell, options)


def find_cell_file(path: Path) -> Path:
    """The path, or the shipped example of that name; UserError if there is neither."""
    if path.is_file():
        return path
    names = sorted(example.stem for example in EXAMPLES.glob("*.toml"))
    example = EXAMPLES / f"{path.name.removesuffix('.toml')}.toml"
    if path.parent in (Path("."), Path("control/cell/examples")) and example.is_file():
        return example
    raise UserError(
        f"there is no cell file {path}; a twin writes its own (touchgoal twin), and these examples "
        f"can be named: {', '.join(names)} (in {EXAMPLES})"
    )


def _read(config: Config) -> CellConfig:
    path = find_cell_file(config.cell)
    cell = read_cell_file(path, config.policy)
    if config.sim:
        cell = replace(cell, arm="sim")
    if config.seed is not None:
        if cell.arm != "sim" and not cell.task.twin:
            raise UserError("--seed is of a simulated arm or a twin: nobody can set a real scene")
        cell = replace(cell, task=replace(cell.task, seed=config.seed))
    return cell


def _connect(cell: CellConfig) -> CellConnection:
    if cell.arm == "sim":
        return simulate_cell(cell, ft.CONTROL_HZ)
    return connect_cell(cell, ft.CONTROL_HZ)


def _summary(cell: CellConfig, config: Config) -> str:
    """What is going to happen, in one line."""
    where = "a simulated FR3 in this program" if cell.arm == "sim" else f"{cell.arm} {cell.address}"
    moves = "it moves" if config.execute else "a dry run, nothing moves"
    return f"{cell.task.name} by {cell.task.policy} on {where}, {cell.task.seconds:g} s at most: {moves}"


def _deploy(
    config: Config,
    cell: CellConfig,
    policy: CellPolicy | None,
    cost: OnlineCost | None,
    connection: CellConnection,
    out: Path,
) -> Result:
    safety = ActionFilter(connection.robot, ft.CONTROL_HZ, cell_watchdogs(cell))
    print("checks before anything moves:", flush=True)
    episodes = out / "episodes"

    def count_episodes() -> int:
        return len(EpisodeWriter(episodes, ft.CONTROL_HZ))

    def record(frames: dict[str, np.ndarray], task: str, meta: dict[str, Any]) -> int:
        return EpisodeWriter(episodes, ft.CONTROL_HZ).append(Episode(frames, task, meta))

    results = preflight(cell, connection, safety, episodes, count_episodes)
    print("\n".join(str(f) for f in results), flush=True)
    require_all_ok(results)
    if config.execute and not config.yes:
        _confirm(cell)
    terminal = Terminal()
    truth = connection.truth or (
        partial(ask_twin, cell.task.twin, "truth") if cell.task.twin else None
    )
    # Scripts end by themselves; of others only a simulator knows when the task is done.
    endless = cell.task.policy != "expert"
    watcher = watch = None
    if endless and truth and cell.time_waits:
        watch = partial(_success, truth)
    elif endless and truth:
        watcher = LatestValue("simulator", partial(_ask_now_and_then, truth))
        watch = watcher.read

    def request() -> Request:
        return terminal.operator_request() or (watch() if watch else "")

    print(f"{'MOVING' if config.execute else 'dry run'}: {HELP}", flush=True)
    with terminal.watching():
        session = Session(
            cell=cell,
            connection=connection,
            safety=safety,
            record=record,
            execute=config.execute,
            make_actor=lambda loop: make_actor(cell, policy, safety, truth, loop.commanded),
            operator_request=request,
            on_tick=terminal.show_tick,
            truth=truth,
            cost=cost.latest_cost if cost else None,
            camera_size=policy.camera_size if policy else ft.CAMERA_SHAPE[:2],
        )
        try:
            return session.run()
        finally:
            if watcher is not None:
                watcher.close()


def _load_cost(cell: CellConfig) -> OnlineCost | None:
    """What measures the distance to the cell's goals."""
    if not cell.task.rewards:
        return None
    goals = [parse_goal(text) for text in cell.task.rewards]
    chosen = cell.task.encoder or pretrained.shipped_encoder_for(cell.sensor)
    encoder = pretrained.load_encoder(chosen, cell.sensor)
    check_words(goals, encoder)
    simulated = cell.arm == "sim" or bool(cell.task.twin)
    path = Path(cell.task.normalizer)
    if not cell.task.normalizer and simulated and not is_published(chosen):
        path = pretrained.find_encoder(chosen) / NORMALIZER
    normalizer = DistanceNormalizer.load(path) if path.is_file() or cell.task.normalizer else None
    towers = load_towers(own_towers(encoder))
    return OnlineCost(CostMeter(towers, encoder, normalizer, goals))


def _success(truth: Callable[[], dict[str, Any]]) -> Request:
    """What a simulator asks for: an end once the task is done."""
    return "success" if truth()["success"] else ""


def _ask_now_and_then(truth: Callable[[], dict[str, Any]]) -> Request:
    time.sleep(_ASKING)
    return _success(truth)


def _confirm(cell: CellConfig) -> None:
    """UserError unless the operator types which arm is to move."""
    name = f"{cell.arm} {cell.address}".strip()
    if not sys.stdin.isatty():
        raise UserError("nobody is there to confirm: run it in a terminal, or add --yes")
    print(f"The arm will move. One hand on its stop, nobody in reach? Type: {name}")
    if input("> ").strip() != name:
        raise UserError("not confirmed; nothing has moved")


def _report(result: Result, out: Path) -> None:
    """Numbers, table and exit status."""
    ending, log = result.ending, result.log
    late = np.array(log.lateness) if log.lateness else np.zeros(1)
    forces = [np.linalg.norm(row[ft.WRENCH][:3]) for row in log.rows]
    numbers = {
        "reason": ending.reason,
        "stopped": ending.stopped,
        "advice": ending.advice,
        "rest_seconds": ending.rest_seconds,
        "success": result.success,
        "progress": result.progress,
        "held_width": result.held_width,
        "episode": result.episode,
        "recording_error": result.recording_error,
        "ticks": len(log.rows),
        "late_p99_ms": 1e3 * float(np.percentile(late, 99)),
        "answered_p95_ms": 1e3 * float(np.percentile(log.answer_times or [0.0], 95)),
        "force_max_newtons": float(max(forces, default=0.0)),
        "clamped": log.limit_counts,
        "arm_pace": log.arm_pace,
    }
    unwritten = ""
    try:
        write_json(out / "metrics.json", numbers)
    except OSError as error:  # the table is printed all the same
        unwritten = f"metrics.json could not be written ({error.strerror}): make room on the disk"
    clamped = ", ".join(f"{name} {n}" for name, n in log.limit_counts.items()) or "never"
    print(f"{len(log.rows)} ticks of the control loop; 99 % began at most {numbers['late_p99_ms']:.1f} ms late, "
          f"95 % were answered within {numbers['answered_p95_ms']:.1f} ms")  # fmt: skip
    print(
        f"largest force on the hand: {numbers['force_max_newtons']:.1f} N; commands limited: {clamped}"
    )
    if log.arm_pace < SLOW_ARM:
        print(slow_arm(log.arm_pace))
    if result.held_width is not None:
        print(f"the hand still holds something, {1e3 * result.held_width:.0f} mm wide")
    if result.episode is not None:
        episodes = out / "episodes"
        print(
            f"episode {result.episode} is in {episodes}; its curves: touchgoal reward-curves {episodes}"
        )
    print(ending if ending.stopped else f"ended: {ending}")
    verdict = {True: "done", False: "not done", None: "nobody can tell whether it is done"}
    if not ending.stopped and (result.episode is not None or result.success is not None):
        print(f"task: {verdict[result.success]}")
    _exit(result, unwritten)


def _exit(result: Result, unwritten: str) -> None:
    """Status and one line on stderr, unless all is well."""
    lost = "; ".join(part for part in (result.recording_error, unwritten) if part)
    if result.ending.stopped:
        also = f"; {lost}" if lost else ""
        print(f"touchgoal deploy: stopped: {result.ending.reason}{also}", file=sys.stderr)
        sys.exit(STOPPED)
    if lost:
        raise UserError(lost)
    if result.success is False:
        print("touchgoal deploy: the task is not done", file=sys.stderr)
        sys.exit(NOT_DONE)

"""Every fault that a deployment must survive, on the twin through the makers' own client libraries.

Each row is one deployment of the pick-and-place expert (or of a broken policy) on an FR3's twin, in
its own process. The fault comes while the arm moves; the twin's truth says what the arm did.
"""

import json
import multiprocessing
import resource
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.deployment.deployed_episode import own_address
from benchmarks.options import BenchmarkOptions
from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import cell_table, read_cell_file
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import connect_cell
from touchgoal.control.cell.limits import cell_watchdogs
from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.control.deployment.actors import make_actor
from touchgoal.control.deployment.control_loop import PLAN_ENDED, ControlLoop
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.control.deployment.session import Session
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor, Planner
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.episodes.episode_recorder import EpisodeRecorder
from touchgoal.episodes.format.repair import validate
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark faults."""

    faults: tuple[str, ...] = ()
    """Names of faults to try, as the table has them; default: all."""
    lock_step: bool = True
    """Let simulated time wait for the client, so that a busy machine does not matter."""


_TIMEOUT = 300.0  # s to wait for any event, on a loaded machine, too
_IN_THE_AIR = 0.08  # m: height of an object that is carried
_UNLIMITED = resource.RLIM_INFINITY
_FORKSERVER = multiprocessing.get_context("forkserver")  # one import of everything serves every row
_FORKSERVER.set_forkserver_preload([__name__])


@dataclass(frozen=True)
class FaultCase:
    """One fault: an order to the twin, a broken policy, a killed process or a full disk; or none."""

    name: str
    control_line: str = ""  # order to the twin's control port
    policy: str = "expert"
    kills: bool = False  # kill the deployment's process
    full: bool = False  # let the disk be full
    carrying: bool = False  # inject the fault once the object is in the air, not once the arm moves


CASES = (
    FaultCase("none"),
    FaultCase("server killed in motion", "kill"),
    FaultCase("arm's link lost alone", "drop"),
    FaultCase("link frozen 0.1 s", "freeze 0.1"),
    FaultCase("link frozen 0.5 s", "freeze 0.5"),
    FaultCase("link frozen 2 s", "freeze 2"),
    FaultCase("camera stalled", "stall front 60"),
    FaultCase("camera frozen on a frame", "repeat front 60"),
    FaultCase("fingertip frozen", "repeat tactile_left 60"),
    FaultCase("fingertip: wrong bytes", "break tactile_left 60"),
    FaultCase("fingertip: half pictures", "halve tactile_left 60"),
    FaultCase("speeds are no numbers", "nonsense on"),
    FaultCase("fingertip unplugged", "lose tactile_left 60"),
    FaultCase("gripper silent", "silence-gripper on"),
    FaultCase("hand does not close", "jam-gripper 0.08"),
    FaultCase("hand jams at 50 mm on air", "jam-gripper 0.05"),
    FaultCase("object lost on the way", "take-object", carrying=True),
    FaultCase("load cell garbled", "garble load_cell 1.0"),
    FaultCase("policy: not a number", policy="nan"),
    FaultCase("policy hangs", policy="hangs"),
    FaultCase("policy raises", policy="raises"),
    FaultCase("policy edits observation", policy="edits"),
    FaultCase("joint limit ahead", policy="outwards"),
    FaultCase("force ceiling met", "nudge 0 29 0 3"),
    FaultCase("contact reflex", "error cartesian_reflex"),
    FaultCase("user stop", "stop-button on"),
    FaultCase("deploy killed (-9)", kills=True),
    FaultCase("disk full", full=True),
)


@dataclass(frozen=True)
class FaultRow:
    """Effect of one fault.

    `rest` is NaN if the fault does not stop the arm, or ends the twin. `episodes_whole` tells whether
    all finished episodes are whole on disk; this run's counts unless its process was killed or its
    disk was full.
    """

    name: str
    message: str  # to the operator
    rest: float  # s (simulated) from the fault until the arm is at rest
    excess: float  # rad beyond the maker's joint range
    speed: float  # share of the maker's joint speed
    force: float  # N, the most that pressed on the robot from outside
    episodes_whole: bool
    late: float  # 99th percentile of the ticks' lateness, ms


def run(config: Config) -> dict[str, Any]:
    """Return the table and its numbers."""
    names = [case.name for case in CASES]
    if unknown := [name for name in config.faults if name not in names]:
        raise UserError(f"there is no fault {unknown[0]!r}; there are: {', '.join(names)}")
    cases = [c for c in CASES if not config.faults or c.name in config.faults]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for i, case in enumerate(cases):
            rows.append(_run(case, Path(folder) / str(i), config.lock_step, i))
            print(_line(rows[-1]), file=sys.stderr, flush=True)
    return {"table": _table(rows), "rows": [vars(row) for row in rows]}


def _run(case: FaultCase, folder: Path, lock_step: bool, number: int) -> FaultRow:
    folder.mkdir()
    broken_at = folder / "broken_at"
    twin = _spawn(_serve, own_address(60 + number), folder, lock_step)
    _wait_until(lambda: (folder / "cell.json").exists() or not twin.is_alive())
    cell = read_cell_file(folder / "cell.json")
    cell = replace(cell, task=replace(cell.task, start=None))
    episodes, report = folder / "episodes", folder / "report"
    deploy = _spawn(_deploy, cell, case, episodes, report, broken_at)
    try:
        before, after = _inject(case, cell, deploy, report)
        deploy.join(_TIMEOUT)
        hung = deploy.is_alive()
    finally:
        for process in (deploy, twin):
            process.kill()
            process.join()
    message, late = "it hangs", float("nan")
    if report.exists():
        late, message = report.read_text().split("\n", 1)
    elif not hung:
        message = "its process is gone; the driver's process brings the arm to rest"
    worst = after["worst"] if after else dict.fromkeys(("excess", "speed", "force"), float("nan"))
    if broken_at.exists():
        before = float(broken_at.read_text())
    stops = message != PLAN_ENDED and (case.kills or case.control_line or broken_at.exists())
    rest = after["time"] - after["rest"] - before if after and stops else float("nan")
    finished = 1 if case.kills or case.full else 2
    # Files of an interrupted episode belong to no episode: not damage.
    damaged = any("belongs to no episode" not in line for line in validate(episodes))
    whole = len(EpisodeSet(episodes)) == finished and not damaged
    return FaultRow(case.name, message, rest, **worst, episodes_whole=whole, late=float(late))


def _inject(
    case: FaultCase, cell: CellConfig, deploy: ForkServerProcess, report: Path
) -> tuple[float, dict[str, Any] | None]:
    """Inject the fault while the arm moves; return its time, and the truth once the arm rests."""
    port = cell.task.twin
    truth = partial(ask_twin, port, "truth")

    def begun() -> bool:
        now = truth()
        if case.carrying:
            return now["layout"]["object"][2] > _IN_THE_AIR
        return max(np.abs(now["dq"])) > 0.1

    _wait_until(lambda: begun() or report.exists() or not deploy.is_alive())
    moment = truth()["time"]
    if case.kills:
        deploy.kill()
    elif case.control_line:
        try:
            ask_twin(port, case.control_line)
        except UserError:  # the twin is gone, as asked
            return moment, None
    _wait_until(lambda: report.exists() or case.kills or not deploy.is_alive())
    _wait_until(lambda: truth()["rest"] > 0.2)
    return moment, truth()


def _serve(host: str, folder: Path, lock_step: bool) -> None:
    """Run the twin, in its own process."""
    task = PickPlaceConfig(cameras=("front",), objects=("wooden_block",))
    twin = Twin(TwinConfig(task, "fr3", 3, host, 0, lock_step, folder))
    write_file(folder / "cell.json", json.dumps(cell_table(twin.cell_config)).encode())
    twin.run()


def _deploy(
    cell: CellConfig, case: FaultCase, episodes: Path, report: Path, broken_at: Path
) -> None:
    """Run the deployment in its own process, with a first, short episode before the fault."""
    connection = connect_cell(cell)
    safety = ActionFilter(connection.robot, ft.CONTROL_HZ, cell_watchdogs(cell))
    truth = connection.truth
    assert truth is not None

    def session(make: Callable[[ControlLoop], Actor], seconds: float) -> Session:
        short = replace(cell, task=replace(cell.task, seconds=seconds))
        recorder = EpisodeRecorder(episodes, ft.CONTROL_HZ)
        return Session(short, connection, safety, recorder, True, make, lambda: "", lambda _: None)

    def expert(loop: ControlLoop) -> Actor:
        return make_actor(cell, None, safety, truth, loop.commanded)

    def mark_broken() -> None:
        broken_at.write_text(str(truth()["time"]))

    def faulty(loop: ControlLoop) -> Actor:
        if case.policy == "expert":
            return expert(loop)
        if case.policy == "hangs":
            return RealTimeActor(HangingPlanner(loop.width, mark_broken))
        return BrokenPolicy(case.policy, loop, mark_broken)

    late, message = float("nan"), ""
    try:
        session(lambda d: BrokenPolicy("still", d, mark_broken), 0.5).run()
        if case.full:  # a file that may not grow fails as on a full disk, in the middle of a write
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, _UNLIMITED))
        result = session(faulty, 10.0 if case.policy == "outwards" else 40.0).run()
        late = 1e3 * float(np.percentile(result.log.lateness or [np.nan], 99))
        message = result.recording_error or result.ending.reason
        if case.policy == "outwards":
            counts = result.log.limit_counts.items()
            message += "; clamped: " + ", ".join(f"{name} {n}" for name, n in counts)
    except UserError as error:  # nothing has moved
        message = f"it did not begin: {error}"
    resource.setrlimit(resource.RLIMIT_FSIZE, (_UNLIMITED, _UNLIMITED))
    report.write_text(f"{late}\n{message}")
    connection.close()


class BrokenPolicy(Actor):
    """A policy that moves well for a second and then breaks."""

    def __init__(self, how: str, loop: ControlLoop, mark_broken: Callable[[], None]) -> None:
        self._how, self._loop, self._mark_broken, self._ticks = how, loop, mark_broken, 0

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See Actor."""
        self._ticks += 1
        n, width = self._loop.commanded().size, self._loop.width
        step = np.zeros(n)
        joint = -1 if self._how == "outwards" else 0  # the wrist meets its limit before the box's
        step[joint] = 0.0 if self._how == "still" else 0.02
        if self._how in ("nan", "raises", "edits") and self._ticks > ft.CONTROL_HZ:
            if self._ticks == ft.CONTROL_HZ + 1:
                self._mark_broken()
            if self._how == "raises":
                raise KeyError("observation.image")
            if self._how == "edits":
                observation[ft.STATE] -= 1
            step[0] = np.nan
        return np.append(step, width)


class HangingPlanner(Planner):
    """A planner that turns the base and then never answers again, in the real planning thread."""

    execution_horizon = 8

    def __init__(self, width: float, mark_broken: Callable[[], None]) -> None:
        self._width, self._mark_broken, self._plans = width, mark_broken, 0

    def plan(self, observations: Sequence[Observation], /) -> np.ndarray:
        """Return three plans, then hang."""
        self._plans += 1
        if self._plans > 3:
            self._mark_broken()
            threading.Event().wait()
        plan = np.zeros((2 * self.execution_horizon, ft.N_JOINTS + 1), np.float32)
        plan[:, 0], plan[:, -1] = 0.02, self._width
        return plan


def _spawn(target: Callable[..., None], *arguments: Any) -> ForkServerProcess:
    process = _FORKSERVER.Process(target=target, args=arguments)
    process.start()
    return process


def _wait_until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + _TIMEOUT
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)


def _line(row: FaultRow) -> str:
    episodes_whole = "whole" if row.episodes_whole else "LOST"
    rest = "-" if np.isnan(row.rest) else f"{row.rest:.2f}"
    limits = f"{'-':>9}{'-':>7}{'-':>8}"
    if not np.isnan(row.excess):
        limits = f"{row.excess:>9.3f}{row.speed:>7.0%}{row.force:>8.1f}"
    late = "-" if np.isnan(row.late) else f"{row.late:.1f}"
    return f"{row.name:<25}{rest:>7}{limits}{late:>8}  {episodes_whole:<7}{row.message}"


def _table(rows: list[FaultRow]) -> str:
    head = f"{'fault':<25}{'rest s':>7}{'beyond':>9}{'speed':>7}{'force N':>8}{'late ms':>8}  "
    head += f"{'whole':<7}what the operator sees"
    return "\n".join([head, *(_line(row) for row in rows)])

"""Every fault that a deployment must survive, on the twin through the makers' own client libraries.

Each row is one deployment of the pick-and-place expert (or of a broken policy) on an FR3's twin. A
process of its own runs it, as `deploy --execute` does, the fault comes while the arm moves, and the
twin's truth says what the arm did.
"""

import json
import multiprocessing
import os
import resource
import signal
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

from touchgoal.control import features as ft
from touchgoal.control.cell.config import Rig, read_rig
from touchgoal.control.cell.connection import open_station, watchdogs_of
from touchgoal.control.errors import UserError
from touchgoal.control.safety.action_filter import Safety
from touchgoal.episodes.metadata import write_file
from touchgoal.episodes.store import EpisodeSet, validate
from touchgoal.policies.acting import Observation
from touchgoal.policies.deploy.actors import Learned, make_actor
from touchgoal.policies.deploy.control_loop import DeployedActor, Deployment
from touchgoal.policies.deploy.session import Session
from touchgoal.policies.policy import PolicyConfig
from touchgoal.sim_envs.pick_place import PickPlaceConfig
from touchgoal.sim_envs.twin.faults import ask
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig

_PATIENCE = 300.0  # s for anything to happen, on a machine however loaded
_UNLIMITED = resource.RLIM_INFINITY
_FORKS = multiprocessing.get_context("forkserver")  # one import of everything serves every row
_FORKS.set_forkserver_preload([__name__])


@dataclass(frozen=True)
class Config:
    """Options of faults."""

    out: Path | None = None
    """Folder of the run."""
    faults: tuple[str, ...] = ()
    """Which rows; default: all."""
    lock_step: bool = True
    """Simulated time waits for the client: for a machine that is busy."""


@dataclass(frozen=True)
class Case:
    """One fault: a line to the twin's port, or a signal, or a policy, or none of these."""

    name: str
    line: str = ""
    policy: str = "expert"
    kills: bool = False
    full: bool = False


CASES = (
    Case("none"),
    Case("server killed in motion", "kill"),
    Case("link frozen 0.1 s", "freeze 0.1"),
    Case("link frozen 0.5 s", "freeze 0.5"),
    Case("link frozen 2 s", "freeze 2"),
    Case("camera stalled", "stall front 60"),
    Case("camera frozen on a frame", "repeat front 60"),
    Case("fingertip unplugged", "lose tactile_left 60"),
    Case("load cell garbled", "garble load_cell 1.0"),
    Case("policy: not a number", policy="nan"),
    Case("policy hangs", policy="hangs"),
    Case("joint limit ahead", policy="outwards"),
    Case("force ceiling met", "nudge 0 22 0 3"),
    Case("contact reflex", "error cartesian_reflex"),
    Case("user stop", "stop-button on"),
    Case("deploy killed (-9)", kills=True),
    Case("disk full", full=True),
)


@dataclass(frozen=True)
class Row:
    """What one fault did.

    Attributes:
        seen: what the operator is told.
        rest: s (simulated) from the fault until the arm is at rest; not a number if the fault stops
            no arm, or takes the controller, and so the twin, away.
        excess: rad beyond the maker's joint range; speed: share of the maker's joint speed.
        force: N, the most that pressed on the robot from outside.
        kept: whether all is on disk and whole that had been finished, this run's episode included
            unless its process or its disk was what failed.
        late: ms by which 99 % of the ticks were late at most.
    """

    name: str
    seen: str
    rest: float
    excess: float
    speed: float
    force: float
    kept: bool
    late: float


def run(config: Config) -> dict[str, Any]:
    """The table and its numbers."""
    names = [case.name for case in CASES]
    if unknown := [name for name in config.faults if name not in names]:
        raise UserError(f"there is no fault {unknown[0]!r}; there are: {', '.join(names)}")
    cases = [c for c in CASES if not config.faults or c.name in config.faults]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for i, case in enumerate(cases):
            rows.append(_run(case, Path(folder) / str(i), config.lock_step, i))
            print(_line(rows[-1]), flush=True)
    return {"table": _table(rows), "rows": [vars(row) for row in rows]}


def _run(case: Case, folder: Path, lock_step: bool, number: int) -> Row:
    folder.mkdir()
    pid = os.getpid()
    host = f"127.{60 + number}.{pid // 250 % 250}.{1 + pid % 250}"
    broke = folder / "broke"
    twin = _spawn(_serve, host, folder, lock_step)
    _until(lambda: (folder / "rig.json").exists() or not twin.is_alive())
    rig = read_rig(folder / "rig.json")
    rig = replace(rig, task=replace(rig.task, start=None))
    episodes, said = folder / "episodes", folder / "said"
    deploy = _spawn(_deploy, rig, case, episodes, said, broke)
    try:
        before, after = _inject(case, rig, deploy, said)
        deploy.join(_PATIENCE)
        hung = deploy.is_alive()
    finally:
        for process in (deploy, twin):
            process.kill()
            process.join()
    seen, late = "it hangs", float("nan")
    if said.exists():
        late, seen = said.read_text().split("\n", 1)
    elif not hung:
        seen = "its process is gone; the driver's child brings the arm to rest"
    worst = after["worst"] if after else dict.fromkeys(("excess", "speed", "force"), float("nan"))
    if broke.exists():
        before = float(broke.read_text())
    stops = seen != "done" and (case.kills or case.line or broke.exists())
    rest = after["time"] - after["rest"] - before if after and stops else float("nan")
    finished = 1 if case.kills or case.full else 2
    kept = len(EpisodeSet(episodes)) == finished and not _damaged(episodes)
    return Row(case.name, seen, rest, **worst, kept=kept, late=float(late))


def _inject(
    case: Case, rig: Rig, deploy: ForkServerProcess, said: Path
) -> tuple[float, dict[str, Any] | None]:
    """Break it while the arm moves; the twin's time then, and its truth once the arm rests."""
    port = rig.task.twin

    def truth() -> dict[str, Any]:
        return ask(port, "truth")

    _until(lambda: max(np.abs(truth()["dq"])) > 0.1 or said.exists() or not deploy.is_alive())
    moment = truth()["time"]
    if case.kills:
        deploy.kill()
    elif case.line:
        try:
            ask(port, case.line)
        except UserError:  # the twin is gone, as asked
            return moment, None
    _until(lambda: said.exists() or case.kills or not deploy.is_alive())
    _until(lambda: truth()["rest"] > 0.2)
    return moment, truth()


def _serve(host: str, folder: Path, lock_step: bool) -> None:
    """The twin's process."""
    task = PickPlaceConfig(cameras=("front",))
    options = {"object": "wooden_block"}
    twin = Twin(TwinConfig(task, "fr3", 3, options, host, 0, lock_step, folder))
    write_file(folder / "rig.json", json.dumps(twin.rig).encode())
    twin.run()


def _deploy(rig: Rig, case: Case, episodes: Path, said: Path, broke: Path) -> None:
    """The deployment's process; a first, short episode is there before the fault comes."""
    station = open_station(rig, ft.CONTROL_HZ)
    safety = Safety(station.robot, ft.CONTROL_HZ, watchdogs_of(rig))
    truth = partial(ask, rig.task.twin, "truth")

    def session(make: Callable[[Deployment], DeployedActor], seconds: float) -> Session:
        short = replace(rig, task=replace(rig.task, seconds=seconds))
        return Session(
            short, station, safety, episodes, True, make, lambda: "", lambda _: None, truth
        )

    def expert(deployment: Deployment) -> DeployedActor:
        return make_actor(rig, None, safety, truth, deployment.commanded)

    def breaks() -> None:
        broke.write_text(str(truth()["time"]))

    session(lambda d: Broken("still", d, breaks), 0.5).run()
    if case.full:  # a file that may not grow fails as on a full disk, in the middle of a write
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, _UNLIMITED))
    makers: dict[str, Callable[[Deployment], DeployedActor]] = {
        "expert": expert,
        "hangs": lambda d: Learned(Hanging(d.width, breaks)),
    }
    make = makers.get(case.policy, lambda d: Broken(case.policy, d, breaks))
    result = session(make, 10.0 if case.policy == "outwards" else 40.0).run()
    late = 1e3 * np.percentile(result.ticks.late or [np.nan], 99)
    resource.setrlimit(resource.RLIMIT_FSIZE, (_UNLIMITED, _UNLIMITED))
    seen = result.trouble or result.ending.reason
    if case.policy == "outwards":
        seen += "; clamped: " + ", ".join(f"{name} {n}" for name, n in result.ticks.acted.items())
    said.write_text(f"{late}\n{seen}")
    station.close()


class Broken:
    """A policy that moves well for a second and then breaks as it is told."""

    done, overdue = False, 0.0

    def __init__(self, how: str, deployment: Deployment, breaks: Callable[[], None]) -> None:
        self._how, self._deployment, self._breaks, self._ticks = how, deployment, breaks, 0

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See DeployedActor."""
        self._ticks += 1
        n, width = self._deployment.commanded().size, self._deployment.width
        step = np.zeros(n)
        joint = -1 if self._how == "outwards" else 0  # the wrist's end comes before the workspace's
        step[joint] = 0.0 if self._how == "still" else 0.02
        if self._how == "nan" and self._ticks > ft.CONTROL_HZ:
            step[0] = np.nan
            if self._ticks == ft.CONTROL_HZ + 1:
                self._breaks()
        return np.append(step, width)

    def close(self) -> None:
        """Nothing is left behind."""


class Hanging:
    """A planner that turns the base and then never answers again, in the real planning thread."""

    config = PolicyConfig(
        touch_dim=0, touch="", observation_horizon=1, execution_horizon=8, prediction_horizon=16
    )

    def __init__(self, width: float, breaks: Callable[[], None]) -> None:
        self._width, self._breaks, self._plans = width, breaks, 0

    def sense(self, seen: Sequence[Observation]) -> None:
        """It has no senses."""

    def plan(self, seen: Sequence[Observation]) -> np.ndarray:
        """Three plans, then none."""
        self._plans += 1
        if self._plans > 3:
            self._breaks()
            threading.Event().wait()
        plan = np.zeros((self.config.prediction_horizon, ft.N_JOINTS + 1), np.float32)
        plan[:, 0], plan[:, -1] = 0.02, self._width
        return plan


def _spawn(target: Callable[..., None], *arguments: Any) -> ForkServerProcess:
    process = _FORKS.Process(target=target, args=arguments)
    process.start()
    return process


def _until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + _PATIENCE
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)


def _damaged(episodes: Path) -> bool:
    """Whether a finished episode is; what an interrupted one left behind belongs to none."""
    return any("belongs to no episode" not in line for line in validate(episodes))


def _line(row: Row) -> str:
    kept = "whole" if row.kept else "LOST"
    rest = "-" if np.isnan(row.rest) else f"{row.rest:.2f}"
    limits = f"{'-':>9}{'-':>7}{'-':>8}"
    if not np.isnan(row.excess):
        limits = f"{row.excess:>9.3f}{row.speed:>7.0%}{row.force:>8.1f}"
    late = "-" if np.isnan(row.late) else f"{row.late:.1f}"
    return f"{row.name:<25}{rest:>7}{limits}{late:>8}  {kept:<7}{row.seen}"


def _table(rows: list[Row]) -> str:
    head = (
        f"{'fault':<25}{'rest s':>7}{'beyond':>9}{'speed':>7}{'force N':>8}{'late ms':>8}  {'kept':<7}"
        "what the operator sees"
    )
    return "\n".join([head, *(_line(row) for row in rows)])

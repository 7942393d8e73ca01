"""One deployment by `touchgoal deploy --execute`, with its result; a `touchgoal twin` to deploy on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from touchgoal.control import features as ft
from touchgoal.control.cell.config import SimulatedTask
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError

REFUSED = "refused"  # how the ending of a deployment that did not begin starts
_TIMEOUT = 1800.0  # s for one deployment on a loaded machine
_START_TIMEOUT, _END_TIMEOUT = 300.0, 60.0  # s for a twin, on a loaded machine
_SHUT = 0.01  # m that fingers must have closed for an attempted grasp


@dataclass(frozen=True)
class Scene:
    """One episode that environment, twin and cell file draw alike."""

    task: SimulatedTask
    seed: int
    item: str  # object or wire


@dataclass(frozen=True)
class Deployment:
    """Result of one deployment."""

    task: str
    policy: str
    arm: str
    seed: int
    item: str
    success: bool
    progress: float | None  # of the task at the end, in [0, 1]; None if unknown
    ending: str
    phase: str  # phase of the grasp at the end, by the fingers
    seconds: float
    peak_force: float  # external, on the hand, N
    clamped: dict[str, float]  # share of the ticks in which each limit changed the command
    late: float  # 99th percentile of the ticks' lateness, ms
    pace: float = 1.0  # arm clock over wall clock in the median second; 1 in lock-step


def deploy(
    cell: Path, scene: Scene, policy: str, arm: str, seconds: float, out: Path, own_task: str = ""
) -> Deployment:
    """Run `touchgoal deploy --execute` on a cell file in its own process, for some time at most.

    With the name of a task of one's own its success is not known: the scene's truth has it.
    """
    table = json.loads(cell.read_text())
    table["task"]["seconds"] = seconds
    cell.write_text(json.dumps(table))
    command = [sys.executable, "-m", "touchgoal.launch", "deploy", str(cell), "--policy", policy]
    command += ["--execute", "--yes", "--seed", str(scene.seed), "--out", str(out)]
    command += ["--task", own_task] if own_task else []
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, env=env)
    kind = (scene.task, policy, arm, scene.seed, scene.item)
    report = out / "metrics.json"
    if not report.exists():  # refused, or crashed
        ending = f"{REFUSED}: {' '.join(done.stderr.split())[-300:]}"
        return Deployment(*kind, False, None, ending, "", 0.0, 0.0, {}, 0.0)
    metrics = json.loads(report.read_text())
    ticks = max(1, metrics["ticks"])
    return Deployment(
        *kind,
        bool(metrics["success"]),
        metrics["progress"],
        metrics["reason"],
        _phase(out / "episodes", metrics["held_width"] is not None),
        metrics["ticks"] / ft.CONTROL_HZ,
        metrics["force_max_newtons"],
        {name: count / ticks for name, count in metrics["clamped"].items()},
        metrics["late_p99_ms"],
        metrics["arm_pace"],
    )


def _phase(episodes: Path, holding: bool) -> str:
    if holding:
        return "holding"
    if not episodes.exists() or not len(found := EpisodeSet(episodes)):
        return "not begun"
    width = found.read(len(found) - 1).frames[ft.STATE][:, -1]
    return "let go or missed" if width.max() - width.min() > _SHUT else "reaching"


@contextmanager
def deployed_twin(scene: Scene, lock_step: bool, folder: Path, number: int) -> Iterator[Path]:
    """Run a twin with a scene and yield the cell file that it wrote.

    Twins of different numbers run side by side. UserError: the twin does not start.
    """
    kind = "--env.wires" if scene.task == "bead-maze" else "--env.objects"
    command = [sys.executable, "-m", "touchgoal.launch", "twin", "--task", scene.task]
    command += [kind, scene.item, "--seed", str(scene.seed), "--port", "0", "--out", str(folder)]
    command += ["--host", own_address(100 + number % 100)]
    command += ["--lock-step"] * lock_step
    cell_file, end = folder / "cell.json", time.monotonic() + _START_TIMEOUT
    with (folder / "twin.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            while not cell_file.exists():
                if process.poll() is not None or time.monotonic() > end:
                    raise UserError(f"no twin: {(folder / 'twin.log').read_text()[-500:]}")
                time.sleep(0.05)
            yield cell_file
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(_END_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()


def own_address(number: int) -> str:
    """Return a loopback address that only this process uses, one a number."""
    pid = os.getpid()
    return f"127.{number}.{pid // 250 % 250}.{1 + pid % 250}"

"""Success of deployed policies by task, policy and arm, with the reason of every failure.

Each deployment is one `touchgoal deploy --execute`; on the wire each has a fresh twin and the cell
file that the twin writes. All rows of a task share seeds, objects and wires.
"""

import json
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from benchmarks.deployment.deployed_episode import Deployment, Scene, deploy, deployed_twin
from benchmarks.options import CORES, BenchmarkOptions
from touchgoal.control.cell.cell_file import cell_table, read_cell_file
from touchgoal.control.cell.config import SimulatedTask
from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.policies.by_name import prepare_policy
from touchgoal.policies.evaluation.evaluate import run_trial, trial_specs
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Positive, Seed, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig

Arm = Literal["environment", "in-process", "lock-step", "real-time"]


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark deploy."""

    tasks: tuple[SimulatedTask, ...] = ("pick-place", "bead-maze")
    """Tasks."""
    policies: tuple[str, ...] = ("scripted", "shipped")
    """Policies, named as for deploy; scripted: the task's own, the expert or the follower."""
    arms: tuple[Arm, ...] = get_args(Arm)
    """Ways to act: the task's environment; a simulated arm in process, from the example cell file; a
    fresh twin over libfranka, whose time waits for the client (lock-step) or not (real-time)."""
    episodes: Count = 10
    """Episodes of each row."""
    seconds: Positive = 40.0
    """Time limit of a deployment, s."""
    seed: Seed = seeds.DEPLOY_TEST.start
    """Random seed of the first episode; each further one adds one."""
    workers: Count = CORES
    """Deployments side by side, in process and in lock-step."""


_SCRIPTED = {"pick-place": "expert", "bead-maze": "follower"}  # by an arm
EXAMPLES = {"pick-place": "sim.toml", "bead-maze": "sim_maze.toml"}
_CELLS = Path(__file__).parents[2] / "control" / "cell" / "examples"


def run(config: Config) -> dict[str, Any]:
    """Run every deployment and return the table."""
    head = f"{'task, policy, arm':<34}{'success [95 % Wilson]':<23}{'peak N':>12}{'late ms':>9}{'pace':>6}  clamped"
    lines, done = [head], []
    for task in config.tasks:
        scenes = list(_scenes(task, config))
        for name in config.policies:
            policy = _SCRIPTED[task] if name == "scripted" else name
            for arm in config.arms:
                rows = _deploy_all(scenes, policy, arm, config)
                lines += (own := _lines(rows))
                print("\n".join(own), file=sys.stderr)
                done += rows
    return {"table": "\n".join(lines), "deployments": [asdict(row) for row in done]}


def _scenes(task: SimulatedTask, config: Config) -> Iterator[Scene]:
    """Yield test wires, or each object in turn."""
    drawn = BeadMazeConfig(split="test") if task == "bead-maze" else PickPlaceConfig()
    for spec in trial_specs(drawn, config.episodes, config.seed):
        assert spec.options is not None
        yield Scene(task, spec.seed, str(next(iter(spec.options.values()))))


def _deploy_all(scenes: list[Scene], policy: str, arm: Arm, config: Config) -> list[Deployment]:
    """Deploy in each scene. On an arm deployments are processes, and real-time ones run alone."""
    bar, jobs = f"{scenes[0].task}, {policy}, {arm}", list(enumerate(scenes))
    one = partial(_deploy, policy, arm, config.seconds)
    if arm == "environment":
        with parallel_map(one, jobs, config.workers) as rows:
            return list(track(rows, bar, "deployment", total=len(jobs)))
    with ThreadPoolExecutor(1 if arm == "real-time" else config.workers) as pool:
        return list(track(pool.map(one, jobs), bar, "deployment", total=len(jobs)))


def _deploy(policy: str, arm: str, seconds: float, job: tuple[int, Scene]) -> Deployment:
    number, scene = job
    if arm == "environment":
        return _in_environment(scene, policy)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if arm == "in-process":
            cell = _example_cell(scene, folder / "cell.json")
            return deploy(cell, scene, policy, arm, seconds, folder / "run")
        with deployed_twin(scene, arm == "lock-step", folder, number) as cell:
            return deploy(cell, scene, policy, arm, seconds, folder / "run")


def _example_cell(scene: Scene, path: Path) -> Path:
    cell = read_cell_file(_CELLS / EXAMPLES[scene.task])
    kind, other = ("wires", "objects") if scene.task == "bead-maze" else ("objects", "wires")
    task = replace(cell.task, seed=scene.seed, **{kind: (scene.item,), other: ()})
    path.write_text(json.dumps(cell_table(replace(cell, task=task))))
    return path


def _in_environment(scene: Scene, policy: str) -> Deployment:
    maze = scene.task == "bead-maze"
    env = BeadMazeConfig(wires=(scene.item,)) if maze else PickPlaceConfig(objects=(scene.item,))
    maker, task = prepare_policy(policy, env)
    trial = run_trial(task, maker, EpisodeSpec(scene.seed))
    ending, peak = trial.failure or "done", trial.peak_force
    result = trial.success, trial.progress, ending, "", trial.seconds, peak, {}, 0.0
    return Deployment(scene.task, policy, "environment", scene.seed, scene.item, *result)


def _lines(rows: list[Deployment]) -> list[str]:
    first = rows[0]
    rate = SuccessRate(sum(row.success for row in rows), len(rows))
    peaks = [row.peak_force for row in rows]
    limits = sorted({name for row in rows for name in row.clamped})
    shares = {name: np.mean([row.clamped.get(name, 0.0) for row in rows]) for name in limits}
    clamped = ", ".join(f"{name} {share:.0%}" for name, share in shares.items() if share >= 5e-3)
    what = f"{first.task}, {first.policy}, {first.arm}"
    peak = f"{np.median(peaks):.0f} to {max(peaks):.0f}"
    late, pace = max(row.late for row in rows), min(row.pace for row in rows)
    lines = [f"{what:<34}{rate!s:<23}{peak:>12}{late:>9.1f}{pace:>6.2f}  {clamped or 'never'}"]
    for row in rows:
        if not row.success:
            ending = f"{row.ending} at {row.seconds:.1f} s"
            phase = f", {row.phase}" if row.phase else ""
            at = "" if row.progress is None else f", progress {row.progress:.2f}"
            lines.append(f"    {row.seed} {row.item}: {ending}{phase}{at}")
    return lines

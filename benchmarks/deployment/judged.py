"""Verdicts of a judge on deployments over libfranka in lock-step, whose truth only this benchmark reads.

A policy does its task and is ended by the judge, or by time; other runs fail on purpose: the policy's time is
cut short, and in pick-and-place the expert places the object beside its goal, or grasps beside the object.
"""

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from benchmarks.deployment.deployed_episode import REFUSED, Deployment, Scene, deploy, deployed_twin
from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.reward_objects import TRAINING_OBJECTS
from touchgoal.control.cell.config import SimulatedTask
from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.policies.evaluation.evaluate import trial_specs
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.rewards.judging.judge import SHIPPED_JUDGE, find_judge
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Positive, Seed, checked_dataclass
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import BeadMazeConfig

Kind = Literal["policy", "beside", "missed", "cut short"]
_BESIDE = 0.04, 0.08  # m from the goal, or from the grasp


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark deploy-judged."""

    task: SimulatedTask = "pick-place"
    """Task; in the bead maze the wires are those of tests."""
    judge: str = SHIPPED_JUDGE
    """Judge, named as for touchgoal judge."""
    policy: str = "shipped"
    """Policy, named as for deploy."""
    objects: tuple[str, ...] = TRAINING_OBJECTS
    """Objects of pick-and-place, taken in turn: those of the judge's successes."""
    episodes: Count = 40
    """Deployments of the policy."""
    failures: Count = 10
    """Deployments of each kind that fails on purpose."""
    seconds: Positive = 20.0
    """Time limit of a deployment, s; a quarter of it where it is cut short."""
    seed: Seed = seeds.DEPLOY_TEST.start
    """Random seed of the first deployment's scene; each further one adds one."""
    workers: Count = CORES
    """Deployments side by side."""


@dataclass(frozen=True)
class Judged:
    """A deployment, its kind, and what the judge says of it; `run.success` is the simulator's."""

    kind: Kind
    verdict: str
    reasons: list[str]
    success: bool  # by the simulator
    run: Deployment


def run(config: Config) -> dict[str, Any]:
    """Deploy, and compare the verdicts with the simulator's."""
    counts: dict[Kind, int] = {"policy": config.episodes}
    if config.task == "pick-place":
        counts |= {"beside": config.failures, "missed": config.failures}
    counts["cut short"] = config.failures
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    items = config.objects
    if config.task == "bead-maze":
        specs = trial_specs(BeadMazeConfig(split="test"), len(kinds), config.seed)
        items = [str(next(iter((spec.options or {}).values()))) for spec in specs]
    scenes = [Scene(config.task, config.seed + k, items[k % len(items)]) for k in range(len(kinds))]
    with ThreadPoolExecutor(config.workers) as pool:
        done = pool.map(partial(_deploy, config), enumerate(zip(kinds, scenes, strict=True)))
        deployed = list(track(done, "deploying", "deployment", total=len(kinds)))
    rows = [row for row in deployed if row.verdict != REFUSED]
    lines = [f"{'truly':<10}{'runs':>5}{'told so [95 % Wilson]':>24}  other verdicts"]
    for success, verdict in ((True, "success"), (False, "failure")):
        if some := [row for row in rows if row.success is success]:
            told = Counter(row.verdict for row in some)
            right = SuccessRate(told.pop(verdict, 0), len(some))
            others = ", ".join(f"{v} {n} {SuccessRate(n, len(some))}" for v, n in told.items())
            lines.append(f"{verdict:<10}{len(some):>5}{right!s:>24}  {others or 'none'}")
    for row in rows:
        right = row.verdict == ("success" if row.success else "failure")
        end = f"{row.run.ending} at {row.run.seconds:.1f} s, {row.verdict} {'; '.join(row.reasons)}"
        what = f"{row.run.seed} {row.run.item}, {row.kind}, truly {row.success}"
        lines += [] if right else [f"    {what}: {end}"]
    ended = sum(row.run.ending.startswith("the judge") for row in rows)
    refused = len(deployed) - len(rows)
    lines.append(f"ended by the judge: {ended} of {len(rows)}; {refused} could not begin")
    return {"table": "\n".join(lines), "deployments": [asdict(row) for row in deployed]}


def _deploy(config: Config, job: tuple[int, tuple[Kind, Scene]]) -> Judged:
    number, (kind, scene) = job
    with TemporaryDirectory() as name:
        folder = Path(name)
        with deployed_twin(scene, True, folder, number) as cell:
            table = json.loads(cell.read_text())
            task = table["task"]
            task["judge"] = str(find_judge(config.judge).resolve())
            if kind in ("beside", "missed"):
                task |= _changes(kind, ask_twin(task["twin"], "truth")["layout"], scene.seed)
            cell.write_text(json.dumps(table))
            policy = "expert" if kind in ("beside", "missed") else config.policy
            seconds = config.seconds / 4 if kind == "cut short" else config.seconds
            run = deploy(cell, scene, policy, kind, seconds, folder / "run")
            if run.ending.startswith(REFUSED):
                return Judged(kind, REFUSED, [run.ending], False, run)
            success = bool(ask_twin(task["twin"], "truth")["success"])
        judged = json.loads((folder / "run" / "metrics.json").read_text())["judged"]
    told = judged or {"verdict": "not asked", "reasons": []}
    return Judged(kind, told["verdict"], told["reasons"], success, run)


def _changes(kind: Kind, layout: dict[str, Any], seed: int) -> dict[str, Any]:
    """Return the keys of the cell file's task that make an expert's run fail on purpose."""
    rng, (x, y, *grasp), goal = np.random.default_rng(seed), layout["grasp"], layout["goal"]
    angle = rng.uniform(0, 2 * np.pi)
    dx, dy = rng.uniform(*_BESIDE) * np.array([np.cos(angle), np.sin(angle)])
    if kind == "missed":
        return {"grasp": [x + dx, y + dy, *grasp], "goal": goal}
    return {"grasp": [x, y, *grasp], "goal": [goal[0] + dx, goal[1] + dy]}

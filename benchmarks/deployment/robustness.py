"""Success of the shipped policies under changes that training has not shown.

All rows of a task share their seeds.
"""

import sys
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from touchgoal.benchmarks.options import CORES, BenchmarkOptions
from touchgoal.policies.evaluation.evaluate import evaluate
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import TASKS, BeadMazeConfig, BrightnessChange, TaskConfig, TaskName


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark robustness."""

    tasks: tuple[TaskName, ...] = tuple(TASKS)
    """Tasks; the maze is on validation wires."""
    policy: str = "shipped"
    """Policy, named as for run-policy."""
    light: tuple[BrightnessChange, ...] = (-0.15, -0.05, 0.0, 0.1, -0.8)
    """Changes of the fingertips' light after the first picture, as shares; a row each."""
    as_deployed: bool = False
    """Let the arm behave as deployed."""
    episodes: Count = 20
    """Episodes of each row."""
    seed: Seed = seeds.POLICY_TEST.start
    """Random seed of the first episode; each further one adds one."""
    workers: Count = CORES
    """Processes that simulate."""


def run(config: Config) -> dict[str, Any]:
    """Return success by task and change, with the trials."""
    lines = [f"{'':<38}{'success [95 % Wilson]':<24}{'peak force N, mean':>19}{'sd':>6}{'max':>6}"]
    rows = []
    for task in config.tasks:
        for change in config.light:
            result = evaluate(
                config.policy,
                _task_config(task, change, config.as_deployed),
                episodes=config.episodes,
                seed=config.seed,
                workers=config.workers,
            )
            what = f"{task}, light {100 * change:+.0f} %" if change else f"{task}, unchanged"
            peak = [trial.peak_force for trial in result.trials]
            lines.append(
                f"{what:<38}{result!s:<24}{np.mean(peak):>19.1f}{np.std(peak):>6.1f}{max(peak):>6.1f}"
            )
            print(lines[-1], file=sys.stderr, flush=True)
            trials = [asdict(trial) for trial in result.trials]
            rows.append({"task": task, "light": change, "trials": trials})
    return {"table": "\n".join(lines), "rows": rows}


def _task_config(task: TaskName, light: float, as_deployed: bool) -> TaskConfig:
    config = BeadMazeConfig(split="validation") if task == "bead-maze" else TASKS[task]()
    return replace(config, light_change=(light,), as_deployed=as_deployed)

"""Success and force of one policy in several environments; all rows of a task share their seeds."""

import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any, get_args

import numpy as np

from benchmarks.options import CORES, BenchmarkOptions
from touchgoal.control.cell.config import SimulatedTask
from touchgoal.policies.by_name import choose_policy
from touchgoal.policies.checkpoint import EPISODE_OBJECT, SavedPolicy
from touchgoal.policies.evaluation.evaluate import (
    FALSELY_DONE,
    GAVE_UP,
    REFUSED,
    Evaluation,
    evaluate,
)
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import ENVS, BeadMazeConfig, PickPlaceConfig, TaskConfig, TaskName

UNCHANGED = "unchanged"  # row of a table
_COUNTED = REFUSED, GAVE_UP, FALSELY_DONE  # failures that a row counts
TABLE_HEAD = f"{'':<46}{'success [95 % Wilson]':<24}{'peak force N, mean':>19}{'sd':>6}{'max':>6}"


@checked_dataclass
class TrialOptions(BenchmarkOptions):
    """Options of a benchmark that tries a policy."""

    policy: str = "shipped"
    """Policy, named as for run-policy."""
    episodes: Count = 20
    """Episodes of each row."""
    seed: Seed = seeds.POLICY_TEST.start
    """Random seed of the first episode; each further one adds one."""
    workers: Count = CORES
    """Processes that simulate."""


def deployed(task: TaskName) -> TaskConfig:
    """Return a task as deployed, if it can be: of the maze test wires, the hand up to 10 degrees askew."""
    base = replace(ENVS[task], as_deployed=task in get_args(SimulatedTask))
    if isinstance(base, BeadMazeConfig):
        return replace(base, split="test", start_angle=10.0)
    return base


def try_cases(config: TrialOptions, cases: Iterable[tuple[str, TaskConfig]]) -> dict[str, Any]:
    """Return the table and the trials of a policy in each named environment."""
    lines, rows = [TABLE_HEAD], []
    for what, task in cases:
        result = evaluate(
            config.policy,
            task,
            episodes=config.episodes,
            seed=config.seed,
            workers=config.workers,
            target=_target(config.policy, task),
        )
        lines.append(table_row(what, result))
        print(lines[-1], file=sys.stderr, flush=True)
        rows.append({"what": what, "trials": [asdict(trial) for trial in result.trials]})
    return {"table": "\n".join(lines), "rows": rows}


def _target(policy: str, task: TaskConfig) -> str | None:
    """Return a sentence with the object's name where others lie beside it; experts need none."""
    if not isinstance(task, PickPlaceConfig) or not task.distractors:
        return None
    maker, _ = choose_policy(policy, task)
    reads = isinstance(maker, SavedPolicy) and maker.is_estimated
    return f"the {EPISODE_OBJECT}" if reads else None


def table_row(what: str, result: Evaluation) -> str:
    """Return a line of the table under `TABLE_HEAD`."""
    peak = [trial.peak_force for trial in result.trials]
    force = f"{np.mean(peak):>19.1f}{np.std(peak):>6.1f}{max(peak):>6.1f}"
    failures = Counter(trial.failure for trial in result.trials)
    counts = [f"  {failures[how]} {how}" for how in _COUNTED if how in failures]
    return "".join([f"{what:<46}{result!s:<24}{force}", *counts])

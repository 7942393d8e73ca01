"""A task of one's own from few demonstrations, improved by its own runs, as `touchgoal improve` does it.

The runs are filtered by a judge, by the simulator's truth, or not at all; the first round's runs, by the policy
of the demonstrations alone, are the same in all. A block goes on a disc, by sight. No success ends a run; a trial
counts if the block lies where it should at the end. What the folder of an earlier run holds is taken from there.
"""

import shutil
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import numpy as np

from benchmarks.options import CORES, BenchmarkOptions
from touchgoal.episodes.outcomes.judged import JudgedOutcome
from touchgoal.episodes.recording import EpisodeSpec, collect, missing_specs
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.improve import judge_set, train_accepted
from touchgoal.policies.by_name import choose_policy
from touchgoal.policies.evaluation.evaluate import run_trials, trial_specs
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.dagger import DaggerRoles
from touchgoal.policies.training.improve import (
    Improvement,
    Round,
    record_simulated,
    simulation_of,
    true_outcomes,
)
from touchgoal.rewards.judging.judge import SHIPPED_JUDGE
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.sim_envs.config import PickPlaceConfig

Filter = Literal["judge", "truth", "none"]
_DEMONSTRATED = PickPlaceConfig(objects=("wooden_block",), rest=1.0, disturbance=0.01)


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark improve."""

    judge: str = SHIPPED_JUDGE
    """Judge of filter judge, named as for touchgoal judge; fitted on other episodes than these."""
    filters: tuple[Filter, ...] = get_args(Filter)
    """What accepts runs: a judge, the simulator's truth, or nothing (all are accepted)."""
    demonstrations: Count = 15
    """Demonstrations by the feedback expert; a fifth as many are recorded to validate on."""
    rounds: Count = 3
    """Rounds of runs and training."""
    runs: Count = 50
    """Runs in each round."""
    trials: Count = 40
    """Trials of the policy before and of those after, on other scenes."""
    train: str = "--preset sight"
    """Options of train-policy."""
    workers: Count = CORES
    """Processes that simulate."""


def run(config: Config) -> dict[str, Any]:
    """Record, improve by each filter, try the policies."""
    if config.out is not None:
        return _run(config, config.out)
    with TemporaryDirectory() as folder:
        return _run(config, Path(folder))


def _run(config: Config, out: Path) -> dict[str, Any]:
    data = _demonstrate(out / "demonstrations", seeds.TRAINING, config.demonstrations, config)
    fifth = max(1, config.demonstrations // 5)
    validation = _demonstrate(out / "validation", seeds.VALIDATION, fifth, config)
    env = simulation_of(EpisodeSet(data))
    assert env is not None
    record = partial(record_simulated, env, config.workers)
    train = partial(train_accepted, validation, config.train)

    def success(policy: Path) -> SuccessRate:
        make, needed = choose_policy(policy, env)
        specs = trial_specs(needed, config.trials, seeds.POLICY_TEST.start)
        trials = list(run_trials(needed, make, specs, config.workers))
        return SuccessRate(sum(t.success for t in trials), len(trials))

    first = Improvement(out / "first", data, config.runs, record, _everything, train)
    assert not list(first.rounds(0))
    root = first.out / "episodes"
    if (done := len(EpisodeSet(root)) - config.demonstrations) < config.runs:
        record(first.policy(0), root, range(done, config.runs))
    before = success(first.policy(0))
    lines = [
        f"{config.demonstrations} demonstrations, {config.rounds} rounds of {config.runs} runs; "
        "success of policies in trials [95 % Wilson]",
        f"{'filter':<8}{'success':>22}{'accepted':>10}{'of them right':>15}  right runs by round",
        f"{'before':<8}{before!s:>22}",
    ]
    rows: dict[str, list[dict[str, Any]]] = {"before": [{"successes": before.successes}]}
    for name in config.filters:
        if not (folder := out / name).exists():
            shutil.rmtree(out / "unfinished", ignore_errors=True)
            shutil.copytree(first.out, out / "unfinished")
            (out / "unfinished").rename(folder)
        label = {"judge": partial(judge_set, config.judge), "truth": _truth, "none": _everything}
        work = Improvement(folder, data, config.runs, record, label[name], train)
        rounds = list(work.rounds(config.rounds))
        after, (accepted, right) = success(work.policy(config.rounds)), _accepted(rounds)
        each = " ".join(str(sum(r.true or [])) for r in rounds)
        lines.append(f"{name:<8}{after!s:>22}{accepted:>10}{right:>15.0%}  {each}")
        known = {"accepted": accepted, "right": right, "rounds": [asdict(r) for r in rounds]}
        rows[name] = [{"successes": after.successes, **known}]
    return {"table": "\n".join(lines), "trials": config.trials, "imitation": rows}


def _demonstrate(folder: Path, drawn: seeds.SeedRange, count: int, config: Config) -> Path:
    specs = [EpisodeSpec(drawn.start + i) for i in range(count)]
    if missing := missing_specs(folder, specs):
        collect(folder, _DEMONSTRATED, missing, config.workers, DaggerRoles())
    return folder


def _everything(episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
    return {i: JudgedOutcome("success") for i in range(len(episodes))}


def _truth(episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
    true = true_outcomes(episodes, range(len(episodes))) or []
    return {i: JudgedOutcome("success" if right else "failure") for i, right in enumerate(true)}


def _accepted(rounds: list[Round]) -> tuple[int, float]:
    """Return the number of accepted runs, and the share of them that are successes."""
    true = [
        t for r in rounds for v, t in zip(r.verdicts, r.true or [], strict=True) if v == "success"
    ]
    return len(true), float(np.mean(true)) if true else 0.0

"""A policy of fragile-carry improved by its own runs in simulation, by what accepts them.

There is no camera: the judge reads touch and force. A policy is trained on a few of the expert's demonstrations,
runs, and is trained on the accepted runs as well, round after round: those that the judge (fitted on the
demonstrations) or the simulator's truth accepts, or all of them. The first round's runs are the same in all three.
The same command continues an interrupted run.
"""

import shutil
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import numpy as np

from benchmarks.deployment.own_task import touchgoal
from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.improve import Filter, everything, go_on_from
from touchgoal.episodes.outcomes.judged import JudgedOutcome
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.improve import judge_set, train_accepted
from touchgoal.policies.evaluation.evaluate import evaluate
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.improve import (
    Improvement,
    record_simulated,
    simulation_of,
    true_outcomes,
)
from touchgoal.rewards.judging.judge import JUDGE
from touchgoal.runtime import seeds
from touchgoal.runtime.json_file import parse_json, write_json
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.sim_envs.config import FragileCarryConfig

_TRIED = seeds.POLICY_TEST.start + 300_000  # scenes of the trials
_DEMONSTRATIONS = seeds.TRAINING.start + 2_000


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark improve-carry."""

    filters: tuple[Filter, ...] = get_args(Filter)
    """What accepts runs: a judge fitted on the demonstrations, the simulator's truth, or none: all are accepted."""
    demonstrations: Count = 20
    """Demonstrations; a fifth as many are recorded to validate on."""
    rounds: Count = 2
    """Rounds of runs and training."""
    runs: Count = 50
    """Runs in each round."""
    trials: Count = 100
    """Episodes of the policy before and of those after, the same for all."""
    train: str = (
        "--representation base_twist --position-noise 0 --head regression --train.epochs 60 "
        "--encoder gelsight_mini_markers_mae"
    )
    """Options of train-policy."""
    workers: Count = CORES
    """Processes that simulate."""


def run(config: Config) -> dict[str, Any]:
    """Record, improve by each filter, try the policies."""
    with TemporaryDirectory() as folder:
        return _run(config, config.out or Path(folder))


def _run(config: Config, out: Path) -> dict[str, Any]:
    counts = config.demonstrations, max(1, config.demonstrations // 5)
    drawn = _DEMONSTRATIONS, seeds.VALIDATION.start
    for name, count, seed in zip(("data", "validation"), counts, drawn, strict=True):
        if not (out / name).exists():
            what = "--task", "fragile-carry", "--episodes", count, "--seed", seed
            touchgoal("collect-demos", *what, "--workers", config.workers, "--out", out / name)
    if not (out / "judge-fit" / JUDGE).exists():
        shutil.rmtree(out / "judge-fit", ignore_errors=True)
        data = out / "data" / "episodes"
        touchgoal("fit-normalizer", data, "--judge", "--out", out / "judge-fit")
    first = _improvement(config, out, "first", "none")
    for _ in first.rounds(0):
        pass
    demonstrated, root = len(EpisodeSet(first.data)), first.out / "episodes"
    if (done := len(EpisodeSet(root)) - demonstrated) < config.runs:
        first.record(first.policy(0), root, range(done, config.runs))
    before = _success(config, first.policy(0))
    rows = [_improved(config, out, name, first.out) for name in config.filters]
    lines = [
        f"fragile-carry, {config.demonstrations} demonstrations, {config.rounds} rounds of {config.runs} runs; "
        "success of policies in trials [95 % Wilson]",
        f"{'filter':<8}{'success':>22}{'accepted':>10}{'of them right':>15}{'right ones refused':>20}  right by round",
        f"{'before':<8}{before!s:>22}",
    ]
    found = {"before": [{"successes": before.successes}]}
    for name, (after, accepted, true) in zip(config.filters, rows, strict=True):
        right = np.mean([t for t, a in zip(true, accepted, strict=True) if a] or [0])
        refused = np.mean([not a for t, a in zip(true, accepted, strict=True) if t] or [0])
        each = [sum(true[i : i + config.runs]) for i in range(0, len(true), config.runs)]
        lines.append(
            f"{name:<8}{after!s:>22}{sum(accepted):>10}{right:>15.0%}{refused:>20.0%}  "
            + " ".join(map(str, each))
        )
        found[name] = [{"successes": after.successes}]
    return {"table": "\n".join(lines), "trials": config.trials, "imitation": found}


def _improvement(config: Config, out: Path, name: str, filter_: Filter) -> Improvement:
    data, validation = (out / kind / "episodes" for kind in ("data", "validation"))
    env = simulation_of(EpisodeSet(data))
    assert env is not None
    record = partial(record_simulated, env, config.workers)
    label = {
        "judge": partial(judge_set, str(out / "judge-fit")),
        "truth": _truth,
        "none": everything,
    }[filter_]
    train = partial(train_accepted, validation, config.train)
    return Improvement(out / name, data, config.runs, record, label, train)


def _improved(
    config: Config, out: Path, name: Filter, first: Path
) -> tuple[SuccessRate, list[bool], list[bool]]:
    """Return the last policy's success, and of each run whether it was accepted and truly right."""
    go_on_from(first, out / name)
    work = _improvement(config, out, name, name)
    done = list(work.rounds(config.rounds))
    accepted = [verdict == "success" for one in done for verdict in one.verdicts]
    true = [right for one in done for right in one.true or ()]
    return _success(config, work.policy(config.rounds)), accepted, true


def _success(config: Config, policy: Path) -> SuccessRate:
    file = policy.parent / "trials.json"
    if not file.exists():
        task, count = FragileCarryConfig(), config.trials
        found = evaluate(policy, task, episodes=count, seed=_TRIED, workers=config.workers)
        write_json(file, [trial.success for trial in found.trials])
    true = parse_json(file.read_bytes())
    return SuccessRate(sum(true), len(true))


def _truth(episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
    true = true_outcomes(episodes, range(len(episodes))) or []
    return {i: JudgedOutcome("success" if t else "failure") for i, t in enumerate(true)}

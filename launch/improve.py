"""Improve a policy by its own runs: it runs, a judge labels, it is trained on what was accepted, again and again.

In simulation it records the runs itself. On an arm or a twin each run is one of `deploy`, which this command
asks for; started again it goes on. It prints the judged success of each round and, where a simulator knows it,
the true one beside it, which decides nothing. The policy of round n is in `round-n/policy`.
"""

import os
import shlex
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from touchgoal.episodes.outcomes.judged import JudgedOutcome
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, checked_dataclass


@checked_dataclass
class Config:
    """Options of improve."""

    data: Path
    """Episode set of demonstrations; it is copied, and the runs are recorded beside them."""
    validation: Path
    """Episode set for the validation loss, as for train-policy."""
    judge: str = "gelsight_mini"
    """Folder of fit-normalizer --judge, or the name of an encoder that ships with a judge."""
    rounds: Count = 3
    """Rounds of runs, labels and a training."""
    episodes: Count = 50
    """Runs in each round."""
    policy: str | None = None
    """Folder of the policy of the first round; default: trained on the demonstrations."""
    train: str = "--preset sight"
    """Options of train-policy, in one string: --train="--preset sight". Every training begins with fresh
    weights."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""
    out: Path | None = None
    """Folder of the run. The same command continues it: runs and trainings that it holds are skipped."""


def main(config: Config) -> None:
    """Go through the rounds, print and plot them."""
    from touchgoal.encoders.training.trackers import Trackers
    from touchgoal.policies.checkpoint import find_policy
    from touchgoal.policies.training import improve
    from touchgoal.rewards.judging.judge import find_judge
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.provenance import portable
    from touchgoal.runtime.run_folder import open_run

    find_judge(config.judge)  # the options, too, are checked before work
    _, training = read_training(config.validation, config.train, config.data, Path("unused"))
    policy = find_policy(config.policy) if config.policy else None
    env = improve.simulation_of(EpisodeSet(config.data))
    record = partial(improve.record_simulated, env, config.workers) if env else _ask_for_runs
    label = partial(judge_set, config.judge)
    train = partial(train_accepted, config.validation, config.train)
    out = open_run(config.out, "improve", config, adds=True)
    work = improve.Improvement(out, config.data, config.episodes, record, label, train)
    rounds, about = [], portable(asdict(config))
    trackers = Trackers(training.log_with, out, about, training.device)
    for done in work.rounds(config.rounds, policy):
        rounds.append(done)
        print(f"{improve.HEAD}\n{done}", flush=True)
        figures = {f"{name}_success": [r.successes, *r.interval] for name, r in done.rates.items()}
        trackers.log(
            {f"success/{n}": r.successes / r.trials for n, r in done.rates.items()}, done.number
        )
        write_json(out / "metrics.json", {"rounds": [asdict(r) | figures for r in rounds]})
        improve.plot_rounds(rounds).savefig(out / "success.png")
    trackers.close()
    last = work.policy(config.rounds)
    print(f"plot: {out / 'success.png'}\npolicy: {last}")
    print(f"next: touchgoal {'run-policy' if env else 'deploy CELL'} --policy {last}")


def judge_set(judge: str, episodes: EpisodeSet) -> dict[int, JudgedOutcome]:
    """Return what a judge, see `Reward.of_judge`, says of each episode."""
    from touchgoal.rewards.reward import Reward

    found = enumerate(Reward.of_judge(judge).judge(episodes))
    return {i: JudgedOutcome(j.verdict, "judge", j.cost, j.reasons) for i, j in found}


def train_accepted(validation: Path, options: str, data: Path, out: Path) -> None:
    """Train by train-policy on the accepted episodes of a set, or go on with that."""
    module, config = read_training(validation, options, data, out)
    module.main(config)


def read_training(validation: Path, options: str, data: Path, out: Path) -> tuple[Any, Any]:
    """Return train-policy's module and config; UserError or SystemExit: it takes no such options.

    It tries no snapshots, which would choose one by the simulator's verdict.
    """
    from touchgoal.encoders.training.checkpoint import CHECKPOINT
    from touchgoal.launch.__main__ import read_options

    fixed = "--judged", "--trials", "0", "--data", data, "--validation", validation, "--out", out
    resume = ["--resume"] * (out / CHECKPOINT).is_file()
    return read_options("train-policy", [*shlex.split(options), *map(str, fixed), *resume])


def _ask_for_runs(policy: Path, root: Path, numbers: range) -> None:
    command = f"touchgoal deploy CELL --policy {policy} --execute --out {root.parent}"
    raise UserError(
        f"no simulator knows the task, and {len(numbers)} runs are missing: record each by "
        f"{command}, then start this command again"
    )

"""Does a judge tell success from failure in runs of others than those whose successes it was fitted on?

Four hands put held-out objects down: the scripted expert with outcomes on purpose, the feedback expert with
mistakes, a hand led by the scripted teleoperation device, and a policy learnt from 30 demonstrations.
Units and value are the shipped ones, fitted on other objects. Goals are ends of successes with the object: the
scripted expert's, for the led hand, which lets go, its own. The limit is fitted on 20 successes with five
objects and judged on the other five, over 20 draws of the five; the three-way answers with 20 labelled
failures of other objects.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.judged_ends import End, Hand, read_ends, record_hands
from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS
from touchgoal.rewards.judge import Judge
from touchgoal.rewards.metrics import auc
from touchgoal.runtime.option_types import Count, checked_dataclass

_DRAWS = 20
_RIGHT = 0.4  # share of successes at which precision is told
_RECALL = 0.8  # of the limit that precision is told for
_SUCCESSES, _FAILURES = 20, 20  # that a judge is fitted on


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark reward-judge."""

    successes: Count = 40
    """Judged successes of the scripted expert."""
    failures: Count = 10
    """Its judged failures of each kind."""
    demonstrations: Count = 100
    """Judged episodes of each other hand, of which two fifths should be right."""
    workers: Count = CORES
    """Processes that simulate and embed. With --out the same line continues an interrupted run."""


@dataclass(frozen=True)
class Costs:
    """Costs of the judged ends of one hand."""

    cost: Float[np.ndarray, " n"]
    kind: tuple[str, ...]  # "success", or what went wrong
    object: tuple[str, ...]

    @property
    def right(self) -> Bool[np.ndarray, " n"]:
        """Which are successes."""
        return np.array([kind == "success" for kind in self.kind])


def run(config: Config) -> dict[str, Any]:
    """Record and embed what is missing, judge, and return the tables."""
    if config.out is not None:
        return _run(config, config.out)
    with tempfile.TemporaryDirectory() as folder:
        return _run(config, Path(folder))


def _run(config: Config, folder: Path) -> dict[str, Any]:
    hands = record_hands(folder, config.successes, config.failures, config.demonstrations, config.workers)
    costs = {name: _costs(hand.judged) for name, hand in hands.items()}
    others = {name: _costs(hand.other_objects) for name, hand in hands.items()}
    labelled = np.concatenate([c.cost[~c.right] for c in others.values()])
    rows = {
        f"{fitted} -> {judged}" if fitted != judged else judged: _judge(
            costs[fitted], costs[judged], labelled, np.random.default_rng(0)
        )
        for fitted in costs
        for judged in costs
        if (fitted == judged or "let go" not in (hands[fitted].end, hands[judged].end))
    }
    kinds = {name: _kinds(c) for name, c in costs.items()}
    text = "\n\n".join([_rate_table(rows), _kind_table(kinds, costs)])
    return {"table": text, "rates": rows, "auc": kinds, "episodes": {n: len(c.cost) for n, c in costs.items()}}

"""Does a judge tell success from failure in runs of others than those whose successes it was fitted on?

Four hands put held-out objects down: the scripted expert with outcomes on purpose, the feedback expert with
mistakes, a hand led by the scripted teleoperation device, and a policy learnt from 30 demonstrations. Units
and value are the shipped ones, fitted on other objects. Goals are ends of three successes with the object:
the scripted expert's; for the led hand, which lets go, its own. Limits are fitted on 20 successes with five of
the objects and judged on the other five, in 20 draws of these; three-way answers know 20 failures of other
objects, too.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.judged_hands import LETS_GO, End, record_hands
from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS
from touchgoal.rewards.judging.judge import LEAST_SUCCESSES, Judge
from touchgoal.rewards.metrics import auc
from touchgoal.runtime.option_types import Count, checked_dataclass

_DRAWS = 20
_RIGHT, _RECALL = 0.4, 0.8  # share of successes, and recall, at which precision is told
_FITTED = 20  # successes and failures that a judge is fitted on
_MISSING = float("nan")


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark reward-judge."""

    successes: Count = 40
    """Judged successes of the scripted expert."""
    failures: Count = 10
    """Its judged failures of each kind."""
    demonstrations: Count = 100
    """Judged episodes of the feedback expert; half as many of the led hand and of the policy."""
    workers: Count = CORES
    """Processes that simulate and embed. With --out the same line continues an interrupted run."""


def run(config: Config) -> dict[str, Any]:
    """Record and embed what is missing, judge, and return the tables."""
    with tempfile.TemporaryDirectory() as folder:
        return _run(config, config.out or Path(folder))


def _run(config: Config, folder: Path) -> dict[str, Any]:
    sizes = config.successes, config.failures, config.demonstrations
    hands, others = record_hands(folder, *sizes, config.workers)
    return judge_hands(hands, others)


@dataclass(frozen=True)
class _Costs:
    """Costs of the ends of one hand."""

    cost: Float[np.ndarray, " n"]
    kind: Sequence[str]  # "success", or what went wrong
    object: Sequence[str]

    @classmethod
    def of(cls, ends: Sequence[End]) -> "_Costs":
        return cls(
            np.array([e.cost for e in ends]), [e.kind for e in ends], [e.object for e in ends]
        )

    @property
    def right(self) -> Bool[np.ndarray, " n"]:
        return np.array([kind == "success" for kind in self.kind])

    def split(self, objects: set[str]) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, " b"]]:
        """Return costs of successes and of failures with some objects."""
        mine = np.array([o in objects for o in self.object])
        return self.cost[mine & self.right], self.cost[mine & ~self.right]


def judge_hands(hands: dict[str, list[End]], others: Sequence[End]) -> dict[str, Any]:
    """Return the tables of ends of several hands; `others` are labelled failures of other objects."""
    costs, failures = (
        {name: _Costs.of(ends) for name, ends in hands.items()},
        [e.cost for e in others],
    )
    pairs = [
        (fitted, judged)
        for fitted in costs
        for judged in costs
        if fitted == judged or LETS_GO not in (fitted, judged)
    ]
    rates = {
        f"{judged}, fitted on {fitted}": _rates(costs[fitted], costs[judged], failures)
        for fitted, judged in pairs
    }
    rates = {name: row for name, row in rates.items() if row}
    kinds = {
        f"{name}: {kind}": value for name, c in costs.items() for kind, value in _aucs(c).items()
    }
    kinds = dict(sorted(kinds.items(), key=lambda row: row[1]["auc"]))
    return {"table": _table(rates, kinds), "rates": rates, "kinds": kinds}


def _rates(fitted: _Costs, judged: _Costs, failures: Sequence[float]) -> dict[str, float]:
    """Return the means over draws of objects; of three-way answers `right` is the share that holds."""
    rng, rows = np.random.default_rng(0), []
    for _ in range(_DRAWS):
        half = {str(o) for o in rng.permutation(HELD_OUT_OBJECTS)[:5]}
        known = fitted.split(half)[0]
        if len(known) < LEAST_SUCCESSES:  # a hand that seldom succeeds
            continue
        known = rng.permutation(known)[:_FITTED]
        good, bad = judged.split(set[str](HELD_OUT_OBJECTS) - half)
        limit = float(np.quantile(known, _RECALL, method="higher"))
        labelled = rng.permutation(np.array(failures))[:_FITTED]
        judge = Judge(tuple(known.tolist()), tuple(labelled.tolist()))
        said = [np.array([judge.verdict(c) for c in side]) for side in (good, bad)]
        told = {v: [_share(s == v) for s in said] for v in ("success", "failure", "unsure")}
        rows.append(
            {
                "recall": _share(good <= limit),
                "false": _share(bad <= limit),
                "unsure": _RIGHT * told["unsure"][0] + (1 - _RIGHT) * told["unsure"][1],
                "success right": _precision(*told["success"]),
                "failure right": 1 - _precision(*told["failure"]),
            }
        )
    if not rows:
        return {}
    found = {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}
    return {"precision": _precision(found["recall"], found["false"])} | found


def _share(which: Bool[np.ndarray, " n"]) -> float:
    return float(which.mean()) if len(which) else _MISSING


def _precision(right: float, wrong: float) -> float:
    """Return the share of right ones among those that shares of right and of wrong ones let through."""
    passed = _RIGHT * right + (1 - _RIGHT) * wrong
    return _RIGHT * right / passed if passed else _MISSING


def _aucs(costs: _Costs) -> dict[str, dict[str, float]]:
    """Return for each kind of failure the AUC, its interval over episodes drawn anew, and the number."""
    rng, good, kinds = np.random.default_rng(0), costs.cost[costs.right], np.array(costs.kind)
    found = {}
    for kind in sorted(set(costs.kind) - {"success"}):
        bad = costs.cost[kinds == kind]
        drawn = [auc(rng.choice(good, len(good)), rng.choice(bad, len(bad))) for _ in range(500)]
        low, high = np.quantile(drawn, [0.025, 0.975])
        found[kind] = {"auc": auc(good, bad), "low": low, "high": high, "episodes": float(len(bad))}
    return found


def _table(rates: dict[str, dict[str, float]], kinds: dict[str, dict[str, float]]) -> str:
    columns = list(next(iter(rates.values())))
    ordered = sorted(rates.items(), key=lambda row: row[1]["precision"])
    lines = [
        f"limit that rejects {1 - _RECALL:.0%} of {_FITTED} successes, {_RIGHT:.0%} right; worst first"
    ]
    lines.append(f"{'judged':<48}" + "".join(f"{c:>15}" for c in columns))
    lines += [f"{name:<48}" + "".join(f"{row[c]:>15.2f}" for c in columns) for name, row in ordered]
    lines += ["", "AUC of the end's cost against successes of the same hand, worst first"]
    lines += [
        f"{name:<40}{row['auc']:>6.2f} [{row['low']:.2f}, {row['high']:.2f}]  of {row['episodes']:.0f}"
        for name, row in kinds.items()
    ]
    return "\n".join(lines)

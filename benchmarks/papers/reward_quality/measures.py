"""How well last costs and curves tell outcomes apart; intervals are a bootstrap over objects.

Episodes of one object share its look and feel, so objects are drawn, each with all its episodes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations

import numpy as np
from jaxtyping import Float

from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS as OBJECTS
from touchgoal.rewards.metrics import spearman

SECOND_COSTS = 0.01
"""Cost of a second in the score of a whole trajectory (last cost + this a second), fixed by the
research note on parts before any episode of this benchmark was recorded."""

_DRAWS = 2000


@dataclass(frozen=True)
class Judged:
    """One judged episode."""

    outcome: str
    object: str  # the one that was asked for
    seconds: float
    costs: dict[str, Float[np.ndarray, " n"]]  # by name of the curve

    def last(self, curve: str) -> float:
        """Return the cost of the last frame."""
        return float(self.costs[curve][-1])

    def score(self, curve: str) -> float:
        """Return the score of the whole trajectory; lower is better."""
        return self.last(curve) + SECOND_COSTS * self.seconds


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % bootstrap interval; NaN where nothing can be compared."""

    value: float
    low: float
    high: float
    n: int  # pairs or episodes behind it
    draws: Float[np.ndarray, " draws"] = field(repr=False, compare=False)  # NaN: nothing drawn

    def __str__(self) -> str:
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"

    def as_dict(self) -> dict[str, float]:
        """Return the figure ready for JSON."""
        return {"value": self.value, "low": self.low, "high": self.high, "n": self.n}


def auc(good: Sequence[Judged], bad: Sequence[Judged], curve: str) -> Estimate:
    """Return the share of pairs in which the bad episode has the larger last cost; ties half."""
    wins, pairs = np.zeros((2, len(OBJECTS), len(OBJECTS)))
    for one in good:
        for other in bad:
            at = OBJECTS.index(one.object), OBJECTS.index(other.object)
            low, high = one.last(curve), other.last(curve)
            wins[at] += (high > low) + 0.5 * (high == low)
            pairs[at] += 1
    won, of = (np.einsum("di,ij,dj->d", _drawn(), m, _drawn()) for m in (wins, pairs))
    return _estimate(wins.sum(), pairs.sum(), won, of)


def mean_of(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean of figures from the same draws of objects."""
    draws = np.mean([e.draws for e in estimates], axis=0)
    value = float(np.mean([e.value for e in estimates]))
    return Estimate(value, *_limits(draws), sum(e.n for e in estimates), draws)


def order(classes: Sequence[Sequence[Judged]], curve: str) -> Estimate:
    """Return the share of pairs of one object from two classes that are in the right order.

    Classes come from best to worst. The better episode must have the smaller score: a tie is wrong.
    """
    right, pairs = np.zeros((2, len(OBJECTS)))
    for better, worse in combinations(classes, 2):
        for k, name in enumerate(OBJECTS):
            low = np.array([e.score(curve) for e in better if e.object == name])
            high = np.array([e.score(curve) for e in worse if e.object == name])
            right[k] += (high[None] > low[:, None]).sum()
            pairs[k] += low.size * high.size
    return _share(right, pairs)


def rank_with_time(episodes: Iterable[Judged], curve: str) -> Estimate:
    """Return the mean rank correlation of falling cost with time; constant curves do not count."""
    sums, counts = np.zeros((2, len(OBJECTS)))
    for e in episodes:
        rank = spearman(-e.costs[curve], np.arange(len(e.costs[curve])))
        if rank is not None:
            sums[OBJECTS.index(e.object)] += rank
            counts[OBJECTS.index(e.object)] += 1
    return _share(sums, counts)


def diagonal(costs: Float[np.ndarray, "goals trajectories"]) -> tuple[float, float]:
    """Return margin and share of wins of the own goal (the diagonal) for one object each.

    Margin: mean last cost to the other goals minus that to the own one, in the unit of the cost.
    """
    own = np.diag(costs)
    others = (costs.sum(axis=0) - own) / (len(costs) - 1)
    nearest = costs.argmin(axis=0) == np.arange(len(costs))
    return float(np.mean(others - own)), float(nearest.mean())


def _share(right: Float[np.ndarray, " k"], pairs: Float[np.ndarray, " k"]) -> Estimate:
    return _estimate(right.sum(), pairs.sum(), _drawn() @ right, _drawn() @ pairs)


@cache
def _drawn() -> Float[np.ndarray, "draws k"]:
    """Return how often each object is drawn, in each of the bootstrap's draws."""
    k = len(OBJECTS)
    return np.random.default_rng(0).multinomial(k, np.full(k, 1 / k), size=_DRAWS).astype(float)


def _estimate(
    part: float,
    whole: float,
    parts: Float[np.ndarray, " draws"],
    wholes: Float[np.ndarray, " draws"],
) -> Estimate:
    if whole == 0:
        nothing = np.full(_DRAWS, np.nan)
        return Estimate(np.nan, np.nan, np.nan, 0, nothing)
    draws = np.where(wholes > 0, parts / np.maximum(wholes, 1e-12), np.nan)
    return Estimate(float(part / whole), *_limits(draws), int(whole), draws)


def _limits(draws: Float[np.ndarray, " draws"]) -> tuple[float, float]:
    if np.isnan(draws).all():
        return np.nan, np.nan
    low, high = np.nanquantile(draws, (0.025, 0.975))
    return float(low), float(high)

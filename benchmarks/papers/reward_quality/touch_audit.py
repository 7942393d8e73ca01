"""Touch-use audit: does a fused cost need the touch of its own episode, at its own time?

Each episode is measured again with its touch replaced; goals stay as they were. Differences are
paired by episode, their intervals a bootstrap over episodes. The goal must not be a frame of the
episode itself: against its own end every replacement costs more, even if touch is useless.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float

from benchmarks.bootstrap import mean_interval, percentile_interval
from touchgoal.rewards.curves import FUSED, Curves
from touchgoal.rewards.features.embedded import FINGERTIPS, TOUCH, EmbeddedEpisode, EmbeddedGoal
from touchgoal.rewards.metrics import auc, measure_curve
from touchgoal.runtime.errors import UserError

REPLACEMENTS = ("neutral", "shuffled", "shifted", "mirrored", "another's")
"""Touch of an episode in place of its own: as in its first frame all the time, its frames in random
order, a second late, left and right exchanged, or of an episode with another object."""

METRICS = ("order", "last cost", "lag", "AUC")
"""Means over successes: rank correlation of the falling cost with time, cost of the last frame, frames
from first contact to half of the fall. Share of pairs in which the failure has the higher last cost."""

_SHIFT = 1.0  # s
_DRAWS = 2000

Measure = Callable[[EmbeddedEpisode, EmbeddedGoal], Curves]


@dataclass(frozen=True)
class AuditRow:
    """One metric with one replacement; NaN where the metric is undefined."""

    metric: str
    replacement: str
    real: float
    replaced: float
    low: float  # 95 % interval of replaced - real
    high: float

    @property
    def change(self) -> str:
        """The difference with its interval."""
        return f"{self.replaced - self.real:+.2f} [{self.low:.2f}, {self.high:.2f}]"


@dataclass(frozen=True)
class AuditTable:
    """Every metric with every replacement, and the verdict."""

    rows: tuple[AuditRow, ...]
    episodes: int

    @property
    def mattered(self) -> bool:
        """Whether the order of the cost gets worse when the touch is shuffled in time."""
        return self._row("order", "shuffled").high < 0

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        row, other = self._row("order", "shuffled"), self._row("last cost", "another's")
        if np.isnan(row.low):
            return "touch use cannot be judged: the order of the cost is undefined"
        if not self.mattered:
            return (
                f"no sign that touch mattered: shuffled in time, the order changes by {row.change}"
            )
        rise = f"{other.replaced - other.real:.2f}" if other.low > 0 else "no"
        return (
            f"touch mattered: shuffled in time, the cost's order changes by {row.change}; "
            f"with another episode's touch the last cost is {rise} higher"
        )

    @property
    def table(self) -> str:
        """The rows as text, and the verdict."""
        head = f"{'metric':<11}{'touch':<11}{'real':>7}{'replaced':>10}   difference, 95 % interval"
        lines = [f"touch-use audit of {self.episodes} episodes", head]
        for r in self.rows:
            values = f"{'-':>7}{'-':>10}   undefined"
            if r.real == r.real:
                values = f"{r.real:>7.2f}{r.replaced:>10.2f}   {r.change}"
            lines.append(f"{r.metric:<11}{r.replacement:<11}{values}")
        return "\n".join([*lines, self.verdict])

    def _row(self, metric: str, replacement: str) -> AuditRow:
        return next(r for r in self.rows if (r.metric, r.replacement) == (metric, replacement))


def audit_touch(
    episodes: Sequence[EmbeddedEpisode], goals: Sequence[EmbeddedGoal], measure: Measure
) -> AuditTable:
    """Return how each metric of the fused cost changes with each replacement of touch.

    Episodes without a recorded outcome count as successes. UserError: fewer than two episodes, one
    without touch, or one with a frame of itself as goal.

    Args:
        episodes: at least two, embedded alike, with touch.
        goals: one per episode, from other episodes.
        measure: returns the curves of an episode to a goal.
    """
    if len(episodes) < 2:
        raise UserError(f"an audit of touch needs at least two episodes, not {len(episodes)}")
    for episode, goal in zip(episodes, goals, strict=True):
        if TOUCH not in episode.features:
            raise UserError(f"{episode.source} has no touch to audit")
        if goal.same_episode:
            raise UserError(
                f"the goal of {episode.source} is a frame of itself, so the audit of touch proves "
                "nothing: give the end of another episode, or a bank of them"
            )
    if FUSED not in measure(episodes[0], goals[0]).costs:
        raise UserError("an audit of touch needs the fused cost: give a --normalizer with units")
    real = _measured(episodes, goals, measure)
    rng, replaced = np.random.default_rng(0), {}
    for name in REPLACEMENTS:
        others = [_replace(name, episodes, k, rng) for k in range(len(episodes))]
        replaced[name] = _measured(others, goals, measure)
    failed = np.array([e.success is False for e in episodes])
    metrics = [m for m in METRICS if m != "AUC" or 0 < failed.sum() < len(failed)]
    pairs = product(metrics, REPLACEMENTS)
    rows = [_row(metric, name, real, replaced[name], failed) for metric, name in pairs]
    return AuditTable(tuple(rows), len(episodes))


def _replace(
    name: str, episodes: Sequence[EmbeddedEpisode], k: int, rng: np.random.Generator
) -> EmbeddedEpisode:
    """Return episode k with its touch replaced as `REPLACEMENTS` says."""
    episode = source = episodes[k]
    rows, sides = np.arange(len(episode)), np.arange(len(episode.sides))
    if name == "neutral":
        rows = np.zeros_like(rows)
    elif name == "shuffled":
        rows = rng.permutation(rows)
    elif name == "shifted":
        rows = np.maximum(rows - round(_SHIFT * episode.fps), 0)
    elif name == "mirrored":
        sides = sides[::-1]
    else:
        later = [*episodes[k + 1 :], *episodes[:k]]
        source = next((e for e in later if e.object != episode.object), later[0])
        rows = np.rint(np.linspace(0, len(source) - 1, len(episode))).astype(int)
    touch = {n: v[rows][:, sides] for n, v in source.features.items() if n in FINGERTIPS}
    return replace(episode, features={**episode.features, **touch})


def _measured(
    episodes: Sequence[EmbeddedEpisode], goals: Sequence[EmbeddedGoal], measure: Measure
) -> dict[str, Float[np.ndarray, " episodes"]]:
    """Return each metric of each episode, NaN where it is undefined."""
    found = []
    for episode, goal in zip(episodes, goals, strict=True):
        metrics = measure_curve(measure(episode, goal).costs[FUSED], episode.contact.frame)
        found.append((metrics.spearman, metrics.end, metrics.contact_lag))
    order, last, lag = np.array(found, float).T
    return {"order": order, "last cost": last, "lag": lag}


def _row(
    metric: str,
    replacement: str,
    real: dict[str, Float[np.ndarray, " n"]],
    replaced: dict[str, Float[np.ndarray, " n"]],
    failed: np.ndarray,
) -> AuditRow:
    if metric == "AUC":
        rng = np.random.default_rng(0)
        good, bad = np.flatnonzero(~failed), np.flatnonzero(failed)
        last, new = real["last cost"], replaced["last cost"]
        before, after = auc(last[good], last[bad]), auc(new[good], new[bad])
        drawn = [(rng.choice(good, len(good)), rng.choice(bad, len(bad))) for _ in range(_DRAWS)]
        changes = [auc(new[g], new[b]) - auc(last[g], last[b]) for g, b in drawn]
        return AuditRow(metric, replacement, before, after, *percentile_interval(changes))
    both = np.isfinite(real[metric]) & np.isfinite(replaced[metric]) & ~failed
    before, after = real[metric][both], replaced[metric][both]
    if len(before) < 2:
        return AuditRow(metric, replacement, np.nan, np.nan, np.nan, np.nan)
    limits = mean_interval(after - before, _DRAWS)
    return AuditRow(metric, replacement, float(before.mean()), float(after.mean()), *limits)

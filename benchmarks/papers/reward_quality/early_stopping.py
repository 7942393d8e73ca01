"""Early stopping of failing runs by the on-line cost, as `deploy` does with `task.give_up`."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.papers.reward_quality.measures import Judged
from touchgoal.rewards.curves import FUSED
from touchgoal.rewards.online import FailureWatch

_RISES = np.arange(0.02, 1.0, 0.01)


def judge_stopping(
    successes: Sequence[Judged], judged: Mapping[str, Sequence[Judged]], fps: float
) -> dict[str, Any]:
    """Return the smallest rise that stops none of some successes, and whom it stops among others.

    By outcome: share of runs that are stopped, and mean share of their time that this saves.
    """
    rise = next(
        float(r) for r in _RISES if all(stopped_at(e, float(r), fps) is None for e in successes)
    )
    outcomes = {}
    for outcome, episodes in judged.items():
        ends = [(stopped_at(e, rise, fps), len(e.costs[FUSED])) for e in episodes]
        saved = [1 - (end + 1) / n for end, n in ends if end is not None]
        share = len(saved) / len(ends)
        outcomes[outcome] = {"stopped": share, "saved": float(np.mean(saved)) if saved else 0.0}
    return {"rise": rise, "outcomes": outcomes}


def stopped_at(episode: Judged, rise: float, fps: float) -> int | None:
    """Return the frame at which a run is stopped; None if it is not."""
    watch = FailureWatch(rise, round(fps))
    return next((i for i, cost in enumerate(episode.costs[FUSED]) if watch.update(cost)), None)


def stopping_text(found: dict[str, Any]) -> str:
    """Return the result as text."""
    shares = ", ".join(
        f"{outcome} {row['stopped']:.2f}" + (f" ({row['saved']:.0%} saved)" if row["saved"] else "")
        for outcome, row in found["outcomes"].items()
    )
    return (
        f"early stopping: a cost that stays {found['rise']:.2f} above its lowest for a second, which no "
        f"demonstration does\nshare stopped: {shares}"
    )

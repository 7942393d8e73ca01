"""The cross-entropy method over a few numbers, for searches whose every trial is a try on an arm."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

Point = Float[np.ndarray, " n"]
Points = Float[np.ndarray, "samples n"]


def search(
    rng: np.random.Generator,
    mean: Point,
    spread: Point,
    rounds: int,
    samples: int,
    costs: Callable[[Points], Sequence[float] | np.ndarray],
) -> Point:
    """Return the last mean: samples are drawn around a mean, and the best third by cost move it.

    Of equal costs the sample that was drawn first wins.
    """
    for _ in range(rounds):
        tried = rng.normal(mean, spread, (samples, len(mean)))
        order = np.argsort(np.asarray(costs(tried)), kind="stable")
        best = tried[order[: max(samples // 3, 2)]]
        mean, spread = best.mean(0), best.std(0)
    return mean

"""95 % intervals by the bootstrap."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def percentile_interval(
    draws: Sequence[float] | Float[np.ndarray, " draws"],
) -> tuple[float, float]:
    """Return the 95 % percentile interval of a statistic's draws."""
    low, high = np.quantile(draws, (0.025, 0.975))
    return float(low), float(high)


def mean_interval(
    values: Sequence[float] | Float[np.ndarray, " n"], draws: int
) -> tuple[float, float]:
    """Return the 95 % interval of a mean; each value is drawn by itself."""
    rows = np.random.default_rng(0).integers(len(values), size=(draws, len(values)))
    return percentile_interval(np.asarray(values)[rows].mean(axis=1))

"""Means of queries in %, with intervals over objects: queries of one object are alike."""

import numpy as np
from jaxtyping import Float, Int

from benchmarks.real_touch.property_probe import interval

Interval = tuple[float, float, float]  # mean and 95 % interval, %


def mean_over_objects(objects: Int[np.ndarray, " q"], value: Float[np.ndarray, " q"]) -> Interval:
    """Return the mean of the queries' values (0 to 1), and its interval by resampling objects."""
    low, high = interval(value, objects)
    return 100 * float(value.mean()), 100 * low, 100 * high


def cell(value: Interval) -> str:
    """Return an interval as it stands in a table."""
    return "{:.1f} [{:.1f}, {:.1f}]".format(*value)

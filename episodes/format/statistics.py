"""Statistics of a feature in LeRobot's format, per episode and merged over a set.

A `Stats` maps min, max, mean, std, count, q01, q10, q50, q90, q99 to nested lists (they go into
JSON and Parquet as they are). Vectors have one number per component; images have one per channel, in
shape (3, 1, 1), with pixel values scaled to [0, 1]. `count` is the number of frames.
"""

import cv2
import numpy as np
from jaxtyping import Float, Shaped, UInt8

Stats = dict[str, list]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def array_statistics(values: Shaped[np.ndarray, "n d"]) -> Stats:
    """Return statistics over the n frames of a numeric or boolean feature of d components."""
    x = values.astype(np.float64)
    stats = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0)}
    stats |= dict(zip(QUANTILES, np.quantile(x, list(QUANTILES.values()), axis=0), strict=True))
    return {name: value.tolist() for name, value in stats.items()} | {"count": [len(x)]}


def image_statistics(images: UInt8[np.ndarray, "n h w 3"]) -> Stats:
    """Return exact statistics over every pixel of n images, from one histogram per channel."""
    histogram = np.zeros((3, 256))
    for image in images:
        for channel in range(3):
            histogram[channel] += cv2.calcHist([image], [channel], None, [256], [0, 256]).ravel()
    columns = [_histogram_statistics(counts) for counts in histogram]
    stats: Stats = {name: [[[c[name] / 255.0]] for c in columns] for name in columns[0]}
    return stats | {"count": [len(images)]}


def _histogram_statistics(counts: Float[np.ndarray, " 256"]) -> dict[str, float]:
    levels = np.arange(256)
    present = np.flatnonzero(counts)
    mean = float(np.average(levels, weights=counts))
    variance = float(np.average((levels - mean) ** 2, weights=counts))
    stats = {"min": float(present[0]), "max": float(present[-1])}
    stats |= {"mean": mean, "std": variance**0.5}
    cumulative = np.cumsum(counts)
    for name, q in QUANTILES.items():
        rank = q * (cumulative[-1] - 1)  # linear between order statistics, numpy's default
        below, above = np.searchsorted(cumulative, [np.floor(rank), np.ceil(rank)], side="right")
        stats[name] = float(below + (above - below) * (rank - np.floor(rank)))
    return stats


def merge(a: Stats, b: Stats) -> Stats:
    """Return the statistics of two sets of frames together.

    Exact for min, max, mean, std and count. Quantiles are the count-weighted mean of the two,
    LeRobot's own approximation (`aggregate_stats` in lerobot's datasets/compute_stats.py).
    """
    n_a, n_b = a["count"][0], b["count"][0]
    share = n_b / (n_a + n_b)
    first = {name: np.asarray(value, np.float64) for name, value in a.items()}
    second = {name: np.asarray(value, np.float64) for name, value in b.items()}
    gap = second["mean"] - first["mean"]
    variance = (1 - share) * first["std"] ** 2 + share * second["std"] ** 2
    merged = {
        "min": np.minimum(first["min"], second["min"]),
        "max": np.maximum(first["max"], second["max"]),
        "mean": first["mean"] + share * gap,
        "std": np.sqrt(variance + share * (1 - share) * gap**2),
    }
    merged |= {
        name: (1 - share) * first[name] + share * second[name]
        for name in QUANTILES
        if name in a and name in b
    }
    return {name: value.tolist() for name, value in merged.items()} | {"count": [n_a + n_b]}

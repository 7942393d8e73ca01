"""Table of metrics over the curves of many episodes, by modality."""

from collections.abc import Sequence
from statistics import mean, median_low

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.report.record import Facts
from touchgoal.rewards.report.text_table import aligned

COLUMNS = {
    "first": ("start", "median cost of the first 5 frames"),
    "last": ("end", "cost of the last frame"),
    "half at": (
        "t_drop_50",
        "first frame by which half of the fall from first to last has happened",
    ),
    "lag": (
        "contact_lag",
        "the same, counted from the first contact; negative if the cost fell before",
    ),
    "mean": ("area", "mean cost of all frames: the earlier it falls, the lower"),
    "bumps": ("peaks", "number of peaks above the noise"),
    "climb": ("largest_rebound", "largest rise above the lowest cost before it"),
    "Spearman": (
        "spearman",
        "rank correlation of -cost with time: 1 if it always falls, -1 if it always rises",
    ),
    "Kendall": (
        "kendall_tau_b",
        "tau-b: pairs of frames in falling less those in rising order, as a share of all",
    ),
}
"""Header -> field of `CurveMetrics`, and line of the legend."""


def metrics_table(curves: Sequence[Curves] | Sequence[Facts], legend: bool = True) -> str:
    """Return a table with a row for each kind of curve, and the meaning of its columns.

    Costs and correlations are means over the episodes; frames and counts are medians (the lower one
    of two), so that they stay whole. A value that some episodes lack is followed by the number of
    those that have it; a dash stands for one that all lack.
    """
    metrics = [c.metrics() for c in curves]
    names = list(dict.fromkeys(name for m in metrics for name in m))
    rows = [["curve", *COLUMNS]]
    for name in names:
        some = [m[name] for m in metrics if name in m]
        rows.append([name, *(_cell([getattr(m, f) for m in some]) for f, _ in COLUMNS.values())])
    n = len(curves)
    lines = [f"{n} {'trajectory' if n == 1 else 'trajectories'}; cost: {curves[0].unit}"]
    if n > 1:
        lines.append("costs and correlations are means, frames and counts are medians")
    lines += aligned(rows)
    if legend:
        lines += [f"  {header:<10}{legend}" for header, (_, legend) in COLUMNS.items()]
        lines.append("  -         undefined: the cost does not fall, or there is no contact")
    return "\n".join(lines)


def _cell(values: list[float | int | None]) -> str:
    defined = [v for v in values if v is not None]
    if not defined:
        return "-"
    count = "" if len(defined) == len(values) else f" (n={len(defined)})"
    if all(isinstance(v, int) for v in defined):
        return f"{median_low(defined)}{count}"
    return f"{mean(defined):.2f}{count}"

"""Table of metrics over the curves of many episodes, by modality."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mean, median_low

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.metrics import CurveMetrics


@dataclass(frozen=True)
class _Column:
    """One column: its header, its value, and its line of the legend."""

    header: str
    value: Callable[[CurveMetrics], float | int | None]
    legend: str


_COLUMNS = (
    _Column("first", lambda m: m.start, "median cost of the first 5 frames"),
    _Column("last", lambda m: m.end, "cost of the last frame"),
    _Column(
        "half at", lambda m: m.t_drop_50, "first frame by which half of that fall has happened"
    ),
    _Column(
        "lag",
        lambda m: m.contact_lag,
        "the same in frames after the first contact; negative if the cost fell before",
    ),
    _Column("mean", lambda m: m.area, "mean cost of all frames: the earlier it falls, the lower"),
    _Column("bumps", lambda m: m.peaks, "number of peaks above the noise"),
    _Column("climb", lambda m: m.largest_rebound, "largest rise above the lowest cost before it"),
    _Column(
        "Spearman",
        lambda m: m.spearman,
        "rank correlation of -cost with time: 1 if it always falls, -1 if it always rises",
    ),
    _Column(
        "Kendall",
        lambda m: m.kendall_tau_b,
        "tau-b: pairs of frames in falling less those in rising order, as a share of all",
    ),
)


def metrics_table(curves: Sequence[Curves], legend: bool = True) -> str:
    """Return a table with a row for each kind of curve, and the meaning of its columns.

    Costs and correlations are means over the episodes; frames and counts are medians (the lower one
    of two), so that they stay whole. A value that some episodes lack is followed by the number of
    those that have it; a dash stands for one that all lack.
    """
    metrics = [c.metrics() for c in curves]
    names = list(dict.fromkeys(name for m in metrics for name in m))
    rows = [["curve", *(column.header for column in _COLUMNS)]]
    for name in names:
        some = [m[name] for m in metrics if name in m]
        rows.append([name, *(_cell([column.value(m) for m in some]) for column in _COLUMNS)])
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    n = len(curves)
    lines = [f"{n} {'trajectory' if n == 1 else 'trajectories'}; cost: {curves[0].unit}"]
    if n > 1:
        lines.append("costs and correlations are means, frames and counts are medians")
    for row in rows:
        cells = (f"{cell:>{width + 2}}" for cell, width in zip(row[1:], widths[1:], strict=True))
        lines.append(f"{row[0]:<{widths[0]}}" + "".join(cells))
    if legend:
        lines += [f"  {column.header:<10}{column.legend}" for column in _COLUMNS]
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

"""One table over the curves of many episodes: how each modality fares beside the others."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mean, median_low

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.metrics import CurveMetrics


@dataclass(frozen=True)
class _Column:
    """One column: its header, what stands in it, and the line of the legend."""

    header: str
    value: Callable[[CurveMetrics], float | int | None]
    legend: str


_COLUMNS = (
    _Column("first cost", lambda m: m.start, "median cost of the first 5 frames"),
    _Column("last cost", lambda m: m.end, "cost of the last frame"),
    _Column(
        "half at frame",
        lambda m: m.t_drop_50,
        "first frame by which the cost has fallen half of the way from first to last",
    ),
    _Column(
        "after contact",
        lambda m: m.contact_lag,
        "the same, in frames after the first contact; negative if the cost fell before",
    ),
    _Column("mean cost", lambda m: m.area, "over all frames: the earlier it falls, the lower"),
    _Column(
        "bumps", lambda m: m.peaks, "times the cost rises to a peak that stands out of its noise"
    ),
    _Column(
        "highest climb",
        lambda m: m.largest_rebound,
        "most that the cost ever rose above the lowest value before it",
    ),
    _Column(
        "Spearman",
        lambda m: m.spearman,
        "rank correlation of -cost with time: 1 if it always falls, -1 if it always rises",
    ),
    _Column(
        "Kendall tau",
        lambda m: m.kendall_tau_b,
        "pairs of frames in falling order less those in rising order, as a share of all",
    ),
)


def metrics_table(curves: Sequence[Curves], legend: bool = True) -> str:
    """A row for each kind of curve, over all episodes, and below it what the columns mean.

    Costs and correlations are means over the episodes; frames and counts are medians (the lower one
    of two), so that they stay whole. A value that is undefined in some episodes is followed by how
    many it is of; one that is undefined in all is a dash.
    """
    metrics = [c.metrics() for c in curves]
    names = list(dict.fromkeys(name for m in metrics for name in m))
    header = f"{'curve':<15}" + "".join(f"{column.header:>15}" for column in _COLUMNS)
    lines = [f"{_episodes(len(curves))}; cost: {curves[0].unit}", header]
    for name in names:
        some = [m[name] for m in metrics if name in m]
        cells = (_cell([column.value(m) for m in some]) for column in _COLUMNS)
        lines.append(f"{name:<15}" + "".join(f"{cell:>15}" for cell in cells))
    if legend:
        lines += [f"  {column.header:<15}{column.legend}" for column in _COLUMNS]
        lines.append("  -              undefined: the cost does not fall, or nothing is touched")
    return "\n".join(lines)


def _episodes(n: int) -> str:
    if n == 1:
        return "1 trajectory"
    return f"{n} trajectories: costs and correlations are means, frames and counts are medians"


def _cell(values: list[float | int | None]) -> str:
    defined = [v for v in values if v is not None]
    if not defined:
        return "-"
    count = "" if len(defined) == len(values) else f" (n={len(defined)})"
    if all(isinstance(v, int) for v in defined):
        return f"{median_low(defined)}{count}"
    return f"{mean(defined):.2f}{count}"

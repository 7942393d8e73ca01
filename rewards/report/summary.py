"""One table over the curves of many episodes: how each modality fares beside the others."""

from collections.abc import Callable, Sequence

import numpy as np

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.metrics import CurveMetrics

_COLUMNS: tuple[tuple[str, Callable[[CurveMetrics], float | None]], ...] = (
    ("start", lambda m: m.start),
    ("end", lambda m: m.end),
    ("drop at frame", lambda m: m.t_drop_50),
    ("after contact", lambda m: m.contact_lag),
    ("area", lambda m: m.area),
    ("peaks", lambda m: m.peaks),
    ("rebound", lambda m: m.largest_rebound),
    ("Spearman", lambda m: m.spearman),
    ("Kendall", lambda m: m.kendall_tau_b),
)


def metrics_table(curves: Sequence[Curves]) -> str:
    """Mean of each metric over the episodes, a row for each kind of curve.

    A metric that is undefined in some episodes is followed by how many it is the mean of; one that
    is undefined in all is a dash. The columns are those of `CurveMetrics`: "drop" is the frame by
    which half of the net drop has fallen, "after contact" its lag in frames.
    """
    metrics = [c.metrics() for c in curves]
    names = list(dict.fromkeys(name for m in metrics for name in m))
    header = f"{'curve':<15}" + "".join(f"{title:>15}" for title, _ in _COLUMNS)
    unit = curves[0].unit
    lines = [f"{len(curves)} episode(s), mean over them; unit of the cost: {unit}", header]
    for name in names:
        some = [m[name] for m in metrics if name in m]
        cells = (_cell([value(m) for m in some]) for _, value in _COLUMNS)
        lines.append(f"{name:<15}" + "".join(f"{cell:>15}" for cell in cells))
    return "\n".join(lines)


def _cell(values: list[float | None]) -> str:
    defined = [v for v in values if v is not None]
    if not defined:
        return "-"
    count = "" if len(defined) == len(values) else f" (n={len(defined)})"
    return f"{np.mean(defined):.2f}{count}"

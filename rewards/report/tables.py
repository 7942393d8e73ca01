"""Tables of measured trajectories: metrics of the curves, last costs by outcome."""

from collections.abc import Sequence
from statistics import mean, median_low

from touchgoal.rewards.curves import Curves, main_first
from touchgoal.rewards.metrics import auc
from touchgoal.rewards.report.record import Facts

_LISTED = 20  # trajectories that are printed by name
MOST_CURVES = 4  # beside the main one, of a printed table
_TITLE = "last cost by outcome, goals from other trajectories"

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
}
"""Header -> field of `CurveMetrics`, and line of the legend."""


def metrics_table(
    curves: Sequence[Curves] | Sequence[Facts], legend: bool = True, most: int | None = None
) -> str:
    """Return a table with a row for each kind of curve, and the meaning of its columns.

    Costs and correlations are means over the episodes; frames and counts are medians (the lower one
    of two), so that they stay whole. A value that some episodes lack is followed by the number of
    those that have it; a dash stands for one that all lack. The main curve is first; of more than
    `most` others, the first ones are shown.
    """
    metrics = [c.measured if isinstance(c, Facts) else c.metrics() for c in curves]
    names = main_first(name for m in metrics for name in m)
    shown = names if most is None else names[: most + 1]
    rows = [["curve", *COLUMNS]]
    for name in shown:
        some = [m[name] for m in metrics if name in m]
        rows.append([name, *(_cell([getattr(m, f) for m in some]) for f, _ in COLUMNS.values())])
    kept = [k for k, cells in enumerate(zip(*rows, strict=True)) if {*cells[1:]} != {"-"}]
    rows = [[row[k] for k in kept] for row in rows]
    n = len(curves)
    lines = [f"{n} {'trajectory' if n == 1 else 'trajectories'}; cost: {curves[0].unit}"]
    if n > 1:
        lines.append("costs and correlations are means, frames and counts are medians")
    lines += aligned(rows)
    if len(shown) < len(names):
        lines.append(f"and {len(names) - len(shown)} more curves: see the page")
    if legend:
        lines += [f"  {header:<10}{COLUMNS[header][1]}" for header in rows[0][1:]]
        if any("-" in row for row in rows):
            lines.append("  -         undefined: the cost does not fall, or there is no contact")
    return "\n".join(lines)


def ends_table(facts: Sequence[Facts]) -> str:
    """Return a table, its title first: object and last cost of the main curves of each trajectory."""
    curves = main_first(name for f in facts for name in f.measured)[: MOST_CURVES + 1]
    rows = [["trajectory", "object", *curves]]
    for f in facts[:_LISTED]:
        ends = (f"{f.measured[c].end:.2f}" if c in f.measured else "-" for c in curves)
        rows.append([f.name, f.object or "-", *ends])
    lines = ["last cost by trajectory", *aligned(rows)]
    if len(facts) > _LISTED:
        lines.append(f"and {len(facts) - _LISTED} more: see the page")
    sentences = {g for f in facts for g in f.goal.values() if g.startswith("text:")}
    if sentences and len({f.object for f in facts}) > 1:
        lines.append("several objects: the sentence may describe some of them only")
    return "\n".join(lines)


def outcome_table(facts: Sequence[Facts]) -> str:
    """Return a table, its title first, with a row per curve: mean last cost of each outcome, and the AUC.

    The AUC is the share of pairs of a failure and a success in which the failure ends at the higher
    cost, a tie counting half; a dash where one of the two is missing. Trajectories whose goal is a frame
    of their own are left out: they end near 0 whatever happened.
    """
    facts = [f for f in facts if not f.own_goal]
    if not facts:
        return f"{_TITLE}\nnone: every goal is a frame of the trajectory itself"
    outcomes = sorted({f.outcome for f in facts}, key=lambda name: (name != "success", name))
    curves = list(dict.fromkeys(name for f in facts for name in f.measured))
    rows = [["curve", *(name or "unknown" for name in outcomes), "AUC"]]
    rows.append(["trajectories", *(str(sum(f.outcome == o for f in facts)) for o in outcomes), ""])
    for curve in curves:
        last = [(f, f.measured[curve].end) for f in facts if curve in f.measured]
        by_outcome = [[end for f, end in last if f.outcome == o] for o in outcomes]
        cells = [f"{mean(ends):.2f}" if ends else "-" for ends in by_outcome]
        failures, successes = ([end for f, end in last if f.success is s] for s in (False, True))
        both = failures and successes
        rows.append([curve, *cells, f"{auc(successes, failures):.2f}" if both else "-"])
    legend = (
        "  AUC       share of (failure, success) pairs in which the failure ends at the higher cost"
    )
    return "\n".join([_TITLE, *aligned(rows), legend])


def _cell(values: list[float | int | None]) -> str:
    defined = [v for v in values if v is not None]
    if not defined:
        return "-"
    count = "" if len(defined) == len(values) else f" (n={len(defined)})"
    if all(isinstance(v, int) for v in defined):
        return f"{median_low(defined)}{count}"
    return f"{mean(defined):.2f}{count}"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines, the first column to the left, the others to the right."""
    width, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [
        f"{first:<{width}}" + "".join(f"{c:>{w + 2}}" for c, w in zip(rest, widths, strict=True))
        for first, *rest in rows
    ]

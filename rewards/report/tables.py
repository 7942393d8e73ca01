"""Tables of measured trajectories: metrics of the curves, last costs by outcome, accepted successes."""

import csv
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from statistics import mean, median_low

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.metrics import auc
from touchgoal.rewards.report.record import Facts
from touchgoal.rewards.success import SuccessThreshold
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

SUCCESSES = "successes.csv"
_LISTED = 20  # trajectories that are printed by name
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
        last = [(f, f.measured[curve]["end"]) for f in facts if curve in f.measured]
        by_outcome = [[end for f, end in last if f.outcome == o] for o in outcomes]
        cells = [f"{mean(ends):.2f}" if ends else "-" for ends in by_outcome]
        failures, successes = ([end for f, end in last if f.success is s] for s in (False, True))
        both = failures and successes
        rows.append([curve, *cells, f"{auc(successes, failures):.2f}" if both else "-"])
    legend = (
        "  AUC       share of (failure, success) pairs in which the failure ends at the higher cost"
    )
    return "\n".join([_TITLE, *aligned(rows), legend])


def success_table(facts: Sequence[Facts], threshold: SuccessThreshold, out: Path) -> str:
    """Write successes.csv; return which trajectories are accepted, and how many of each outcome.

    UserError: the trajectories lack the curve of the threshold.
    """
    rows = [("name", "last_cost", "success")]
    for f in facts:
        if threshold.curve not in f.measured:
            raise UserError(
                f"the success threshold needs the curve '{threshold.curve}', which {f.source} lacks: "
                "measure what it was fitted on, or move success.json away"
            )
        last = float(f.measured[threshold.curve]["end"])
        rows.append((f.name, f"{last:.4f}", "yes" if threshold.accepts(last) else "no"))
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_file(out / SUCCESSES, text.getvalue().encode())
    lines = [str(threshold)]
    if len(facts) <= _LISTED:
        lines += [f"  {name:<20}{last:>8}  success: {answer}" for name, last, answer in rows[1:]]
    accepted = [answer == "yes" for _, _, answer in rows[1:]]
    for outcome in sorted({f.outcome for f in facts}):
        mine = [a for a, f in zip(accepted, facts, strict=True) if f.outcome == outcome]
        lines.append(f"  {outcome or 'unknown outcome'}: {sum(mine)} of {len(mine)} accepted")
    if not any(f.success is False for f in facts):
        lines.append("  how many failures pass is unknown: none is among the trajectories")
    if any(f.own_goal for f in facts):
        lines.append("  a goal is a frame of its own trajectory, which costs 0 whatever happened")
    return "\n".join(lines)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines, the first column to the left, the others to the right."""
    width, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [
        f"{first:<{width}}" + "".join(f"{c:>{w + 2}}" for c, w in zip(rest, widths, strict=True))
        for first, *rest in rows
    ]

"""Table of last costs by outcome, and how well they tell success from failure."""

from collections.abc import Sequence
from statistics import mean

from touchgoal.rewards.metrics import auc
from touchgoal.rewards.report.record import Facts
from touchgoal.rewards.report.text_table import aligned

_TITLE = "last cost by outcome, goals from other trajectories"


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

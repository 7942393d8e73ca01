"""Table of which trajectories a success threshold accepts."""

import csv
from collections.abc import Sequence
from io import StringIO
from pathlib import Path

from touchgoal.rewards.report.record import Facts
from touchgoal.rewards.success import SuccessThreshold
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

SUCCESSES = "successes.csv"
_LISTED = 20  # trajectories that are printed by name


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

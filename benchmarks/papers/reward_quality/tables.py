"""Tables of the benchmark, as text."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from benchmarks.papers.reward_quality.measures import Estimate, Judged
from touchgoal.rewards.report.tables import aligned

Grid = Mapping[str, Mapping[str, Estimate]]  # figures by row and curve


def sizes(judged: Mapping[str, Sequence[Judged]], training: int) -> str:
    """Return the number of episodes by outcome, and of those behind units and value."""
    counts = ", ".join(f"{outcome} {len(episodes)}" for outcome, episodes in judged.items())
    objects = len({e.object for episodes in judged.values() for e in episodes})
    one = next(iter(judged.values()))[0]
    rate = len(next(iter(one.costs.values()))) / one.seconds
    return (
        f"episodes of {objects} held-out objects, {rate:g} frames a second: {counts}; fitted on "
        f"{training} successes of other objects"
    )


def grid(title: str, rows: Grid) -> str:
    """Return a table of values with a column per curve."""
    curves = list(next(iter(rows.values())))
    table = [["", *curves]]
    table += [[name, *(_short(cells[c].value) for c in curves)] for name, cells in rows.items()]
    return "\n".join([title, *aligned(table)])


def intervals(rows: Grid, curves: Iterable[str]) -> str:
    """Return the fused cost's and the plain embedding distance's figures with 95 % intervals."""
    shown = [c for c in ("fused", "image+tactile") if c in curves]
    table = [["", *shown], *([row, *(str(cells[c]) for c in shown)] for row, cells in rows.items())]
    return "\n".join(["95 % intervals (bootstrap over objects)", *aligned(table)])


def diagonals(margins: Mapping[str, Mapping[str, float]]) -> str:
    """Return margin and share of nearest own goals by curve."""
    objects = next(iter(margins.values()))["objects"]
    table = [["", "margin", "own goal nearest"]]
    table += [[c, f"{m['margin']:.2f}", f"{m['nearest']:.2f}"] for c, m in margins.items()]
    title = f"goals by trajectories, one success of each of {objects:.0f} objects"
    return "\n".join([title, *aligned(table)])


def as_json(rows: Grid) -> dict[str, dict[str, Any]]:
    """Return figures and intervals ready for JSON."""
    return {row: {c: e.as_dict() for c, e in cells.items()} for row, cells in rows.items()}


def _short(value: float) -> str:
    return "-" if value != value else f"{value:.2f}"

"""Tables of the benchmark, as text."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from touchgoal.benchmarks.papers.reward_quality.measures import Estimate, Judged
from touchgoal.rewards.success import SuccessThreshold

Grid = Mapping[str, Mapping[str, Estimate]]
"""Figures by row and curve."""


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
    """Return a table of values with a column a curve."""
    curves = list(next(iter(rows.values())))
    widths = [max(len(c), 4) + 2 for c in curves]
    lines = [title, f"{'':<27}" + "".join(f"{c:>{w}}" for c, w in zip(curves, widths, strict=True))]
    for name, cells in rows.items():
        values = (f"{_short(cells[c].value):>{w}}" for c, w in zip(curves, widths, strict=True))
        lines.append(f"{name:<27}" + "".join(values))
    return "\n".join(lines)


def intervals(rows: Grid, curves: Iterable[str]) -> str:
    """Return the fused cost's and the plain embedding distance's figures with 95 % intervals."""
    shown = [c for c in ("fused", "image+tactile") if c in curves]
    lines = [
        "95 % intervals (bootstrap over objects)",
        f"{'':<27}" + "".join(f"{c:>22}" for c in shown),
    ]
    lines += [
        f"{row:<27}" + "".join(f"{cells[c]!s:>22}" for c in shown) for row, cells in rows.items()
    ]
    return "\n".join(lines)


def diagonals(margins: Mapping[str, Mapping[str, float]]) -> str:
    """Return margin and share of nearest own goals by curve."""
    lines = [f"goals by trajectories, one success of each of {_objects(margins):.0f} objects"]
    lines.append(f"{'':<27}{'margin':>8}{'own goal nearest':>18}")
    for curve, found in margins.items():
        lines.append(f"{curve:<27}{found['margin']:>8.2f}{found['nearest']:>18.2f}")
    return "\n".join(lines)


def threshold(fitted: SuccessThreshold, accepted: Mapping[str, float]) -> str:
    """Return the threshold of success and what it accepts."""
    shares = ", ".join(f"{outcome} {share:.2f}" for outcome, share in accepted.items())
    return f"{fitted}\nshare accepted: {shares}"


def as_json(rows: Grid) -> dict[str, dict[str, Any]]:
    """Return figures and intervals ready for JSON."""
    return {row: {c: e.as_dict() for c, e in cells.items()} for row, cells in rows.items()}


def _objects(margins: Mapping[str, Mapping[str, float]]) -> float:
    return next(iter(margins.values()))["objects"]


def _short(value: float) -> str:
    return "-" if value != value else f"{value:.2f}"

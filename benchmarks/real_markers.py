"""Dots of a real gel as our tracker follows them, beside another tracker's reading of the same pictures."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from touchgoal.control.errors import UserError
from touchgoal.control.progress import track
from touchgoal.control.tactile.markers import MarkerTracker
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI_MARKERS, MarkerGrid
from touchgoal.episodes.importers.marker_pictures import MarkerPicture

NEAR = 1.0
"""px within which both trackers agree."""


def judge_markers(pictures: Sequence[MarkerPicture], seed: int) -> dict[str, Any]:
    """Every series followed from its first picture, in order and with the others shuffled, so that dots jump.

    Displacements from the first picture are compared: where a picture's first pixel lies is each tracker's
    own convention.
    """
    series: dict[str, list[MarkerPicture]] = {}
    for picture in pictures:
        series.setdefault(picture.series, []).append(picture)
    short = [name for name, own in series.items() if len(own) < 2]
    if short:
        raise UserError(f"{short[0]} is a single picture: nothing to follow")
    rng = np.random.default_rng(seed)
    rows = {}
    for order in ("in order", "shuffled"):
        followed = []
        for first, *others in track(list(series.values()), order, "recording"):
            rest = (
                others if order == "in order" else [others[i] for i in rng.permutation(len(others))]
            )
            followed.append(_follow(first, rest))
        off, exchanged, lost = (np.concatenate(column) for column in zip(*followed, strict=True))
        rows[order] = {
            "dots": len(off),
            "near": float((off <= NEAR).mean()),
            "median_px": float(np.median(off)),
            "most_px": float(off.max()),
            "exchanged": int(exchanged.sum()),
            "lost": int(lost.sum()),
        }
    return {"frames": len(pictures), "series": len(series), "orders": rows}


def marker_table(result: dict[str, Any]) -> str:
    """As people read it."""
    lines = [
        f"{result['frames']} pictures in {result['series']} series, dots followed from the first of each; displacements beside",
        "another tracker's",
        f"{'pictures':<12}{'dots':>7}{f'within {NEAR:g} px':>14}{'median':>11}{'most':>9}{'exchanged':>11}{'lost':>6}",
    ]
    lines += [
        f"{order:<12}{row['dots']:>7}{row['near']:>14.1%}{row['median_px']:>8.2f} px{row['most_px']:>6.2f} px"
        f"{row['exchanged']:>11}{row['lost']:>6}"
        for order, row in result["orders"].items()
    ]
    return "\n".join(lines)


def _follow(
    first: MarkerPicture, others: Sequence[MarkerPicture]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every dot that the other tracker saw: px between both displacements, whether it is another dot, or lost."""
    grid, pixel_pitch = _grid(first.positions)
    tracker = MarkerTracker(first.frame(), grid, pixel_pitch)
    middle = (tracker.rest.positions - first.positions).mean((0, 1))
    off, exchanged, lost = [], [], []
    for picture in others:
        now = tracker.update(picture.frame())
        seen = picture.seen & first.seen
        theirs = picture.positions - first.positions
        off.append(np.linalg.norm(tracker.displacement - theirs, axis=-1)[seen])
        ours = (now.positions - middle).reshape(-1, 2)
        apart = np.linalg.norm(ours[:, None] - picture.positions.reshape(-1, 2), axis=-1)
        exchanged.append((apart.argmin(1) != np.arange(len(ours)))[seen.ravel()])
        lost.append(~now.found[seen])
    return np.concatenate(off), np.concatenate(exchanged), np.concatenate(lost)


def _grid(positions: Float[np.ndarray, "rows columns 2"]) -> tuple[MarkerGrid, float]:
    """A Mini's dots in so many rows and columns, and m per px at which they are as far apart as its are."""
    dots = GELSIGHT_MINI_MARKERS.markers
    assert dots is not None
    rows, columns, _ = positions.shape
    spacing = np.median(np.linalg.norm(np.diff(positions, axis=1), axis=-1))
    return replace(dots, rows=rows, columns=columns), dots.pitch / float(spacing)

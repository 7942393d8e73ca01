"""Dots of a real gel as our tracker follows them, beside another tracker's reading of the same pictures."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from touchgoal.control.tactile.markers import MarkerTracker
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI_MARKERS, MarkerGrid
from touchgoal.episodes.importers.marker_pictures import MarkerPicture
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

NEAR = 1.0
"""px within which both trackers agree."""


def judge_markers(pictures: Sequence[MarkerPicture]) -> dict[str, Any]:
    """Every series followed from its first picture.

    Displacements from the first picture are compared: where a picture's first pixel lies is each tracker's
    own convention.
    """
    series: dict[str, list[MarkerPicture]] = {}
    for picture in pictures:
        series.setdefault(picture.series, []).append(picture)
    short = [name for name, own in series.items() if len(own) < 2]
    if short:
        raise UserError(f"{short[0]} is a single picture: nothing to follow")
    followed = [
        _follow(first, others)
        for first, *others in track(list(series.values()), "dots", "recording")
    ]
    moved, off, exchanged, lost = (np.concatenate(column) for column in zip(*followed, strict=True))
    return {
        "frames": len(pictures),
        "series": len(series),
        "dots": len(off),
        "near": float((off <= NEAR).mean()),
        "median_px": float(np.median(off)),
        "most_px": float(off.max()),
        "exchanged": int(exchanged.sum()),
        "lost": int(lost.sum()),
        "moved_px": float(moved.max()),
        "apart_px": float(min(_spacing(first.positions) for first, *_ in series.values())),
    }


def marker_table(result: dict[str, Any]) -> str:
    """As people read it."""
    return (
        f"{result['frames']} pictures in {result['series']} series, dots followed from the first of each\n"
        f"{result['dots']} dots: displacement within {NEAR:g} px of another tracker's for {result['near']:.1%}, median "
        f"{result['median_px']:.2f} px, most {result['most_px']:.2f} px\n"
        f"{result['exchanged']} exchanged, {result['lost']} lost; they move by {result['moved_px']:.1f} px at most and lie "
        f"{result['apart_px']:.0f} px apart"
    )


def _follow(
    first: MarkerPicture, others: Sequence[MarkerPicture]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of every dot that the other tracker saw: px that it moved, px between both displacements, whether it is
    another dot, whether it is lost."""
    grid, pixel_pitch = _grid(first.positions)
    tracker = MarkerTracker(first.frame(), grid, pixel_pitch)
    middle = (tracker.rest.positions - first.positions).mean((0, 1))
    rows = []
    for picture in others:
        now = tracker.update(picture.frame())
        seen = picture.seen & first.seen
        theirs = picture.positions - first.positions
        off = np.linalg.norm(tracker.displacement - theirs, axis=-1)
        ours = (now.positions - middle).reshape(-1, 2)
        apart = np.linalg.norm(ours[:, None] - picture.positions.reshape(-1, 2), axis=-1)
        other = (apart.argmin(1) != np.arange(len(ours))).reshape(seen.shape)
        rows.append([x[seen] for x in (np.linalg.norm(theirs, axis=-1), off, other, ~now.found)])
    moved, off, exchanged, lost = (np.concatenate(column) for column in zip(*rows, strict=True))
    return moved, off, exchanged, lost


def _spacing(positions: Float[np.ndarray, "rows columns 2"]) -> float:
    return float(np.median(np.linalg.norm(np.diff(positions, axis=1), axis=-1)))


def _grid(positions: Float[np.ndarray, "rows columns 2"]) -> tuple[MarkerGrid, float]:
    """A Mini's dots in so many rows and columns, and m per px at which they are as far apart as its are."""
    dots = GELSIGHT_MINI_MARKERS.markers
    assert dots is not None
    rows, columns, _ = positions.shape
    return replace(dots, rows=rows, columns=columns), dots.pitch / _spacing(positions)

"""Dots of a real gel followed by our tracker, against another tracker on the same images."""

from collections.abc import Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from benchmarks.options import BenchmarkOptions
from benchmarks.published_touch.marker_images import MarkerImage, has_markers, read_marker_images
from touchgoal.control.tactile.markers.tracker import MarkerTracker
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI_MARKERS, MarkerGrid
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import RARE, Count, checked_dataclass
from touchgoal.runtime.progress import track


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark real-markers."""

    data: Path = field(kw_only=True)
    """Folder with SERIES_NUMBER.png and .json, laid out as gelsight-material-classifier's."""
    every: Annotated[Count, RARE] = 1
    """Use every n-th image."""


NEAR = 1.0  # distance within which both trackers agree, px


def run(config: Config) -> dict[str, Any]:
    """Follow the dots of every series and compare."""
    if not has_markers(config.data):
        raise UserError(f"{config.data} has no SERIES_NUMBER.png with .json beside it")
    result = judge_markers(read_marker_images(config.data)[:: config.every])
    return {"table": marker_table(result), **result}


def judge_markers(images: Sequence[MarkerImage]) -> dict[str, Any]:
    """Follow every series from its first image, and compare displacements.

    Positions would not do: each tracker has its own convention for the first pixel.
    """
    series: dict[str, list[MarkerImage]] = {}
    for image in images:
        series.setdefault(image.series, []).append(image)
    short = [name for name, own in series.items() if len(own) < 2]
    if short:
        raise UserError(f"{short[0]} is a single picture: nothing to follow")
    followed = [
        _follow(first, others)
        for first, *others in track(list(series.values()), "dots", "recording")
    ]
    moved, off, exchanged, lost = (np.concatenate(column) for column in zip(*followed, strict=True))
    return {
        "frames": len(images),
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
    """Return the result as printed text."""
    return (
        f"{result['frames']} pictures in {result['series']} series, dots followed from the first of each\n"
        f"{result['dots']} dots: displacement within {NEAR:g} px of another tracker's for {result['near']:.1%}, median "
        f"{result['median_px']:.2f} px, most {result['most_px']:.2f} px\n"
        f"{result['exchanged']} exchanged, {result['lost']} lost; they move by {result['moved_px']:.1f} px at most and lie "
        f"{result['apart_px']:.0f} px apart"
    )


def _follow(
    first: MarkerImage, others: Sequence[MarkerImage]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return, for every dot of the other tracker: motion (px), difference (px), exchanged, lost."""
    grid, pixel_pitch = _grid(first.positions)
    tracker = MarkerTracker(first.frame(), grid, pixel_pitch)
    middle = (tracker.rest.positions - first.positions).mean((0, 1))
    rows = []
    for image in others:
        now = tracker.update(image.frame())
        found = image.found & first.found
        theirs = image.positions - first.positions
        off = np.linalg.norm(tracker.displacement - theirs, axis=-1)
        ours = (now.positions - middle).reshape(-1, 2)
        apart = np.linalg.norm(ours[:, None] - image.positions.reshape(-1, 2), axis=-1)
        other = (apart.argmin(1) != np.arange(len(ours))).reshape(found.shape)
        rows.append([x[found] for x in (np.linalg.norm(theirs, axis=-1), off, other, ~now.found)])
    moved, off, exchanged, lost = (np.concatenate(column) for column in zip(*rows, strict=True))
    return moved, off, exchanged, lost


def _spacing(positions: Float[np.ndarray, "rows columns 2"]) -> float:
    return float(np.median(np.linalg.norm(np.diff(positions, axis=1), axis=-1)))


def _grid(positions: Float[np.ndarray, "rows columns 2"]) -> tuple[MarkerGrid, float]:
    """Return the Mini's dot grid with these rows and columns, and the pixel pitch in m."""
    dots = GELSIGHT_MINI_MARKERS.markers
    assert dots is not None
    rows, columns, _ = positions.shape
    return replace(dots, rows=rows, columns=columns), dots.pitch / _spacing(positions)

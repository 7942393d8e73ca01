"""Strokes of a probe with force and slip labels: T1 and T2 of TacBench (Sparsh, arXiv 2410.24090, C.2, C.4).

The sets `digit-force-estimation` and `gelsight-force-estimation` hold folders PROBE/BATCH (sphere/batch_1)
with `dataset_digit_NN.pkl` or `dataset_gelsight_NN.pkl`, consecutive lists of encoded images, and
`dataset_slip_forces.pkl`: `in_contact`, one per image, and numbered `trajectories` with `indexes` of the
images, `forces` (n, 3) and `slip_label`. In the flat and sharp batches `indexes` has five more at its end.

Forces are in newtons: Sparsh divides them by 4, 4 and 5 N. The third is normal to the gel; its sign is not
stated and is taken so that pressing is positive. The image directions of the first two are not stated.

GelSight images are stored upright, 320 high, and are turned back counter-clockwise here. One batch
(sharp/batch_2) has red and blue exchanged. Such a batch is recognised by an untouched gel with more
blue than red. Whether the Mini's gel has dots is unknown (name `gelsight_mini_markers` if so).
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from benchmarks.published_touch.labels import booleans, entry, numbers, whole_numbers
from touchgoal.episodes.importers.plain_pickle import read_plain_pickle
from touchgoal.episodes.importers.touch_clip import TouchClip, check_sensor, read_images
from touchgoal.runtime.errors import UserError

STRIDE = 5  # number of images between the two of a pair: 83 ms at a DIGIT's 60 Hz
_LABELS = "dataset_slip_forces.pkl"
_IMAGES = re.compile(r"dataset_(digit|gelsight)_\d+\.pkl")
_KINDS = {"digit": ("digit",), "gelsight": ("gelsight_mini", "gelsight_mini_markers")}
_MOST_NAME = 40
_MOST_FORCE = 100.0  # N: the load cell, an ATI Nano17, ends at 70


@dataclass(frozen=True, eq=False)
class ForceStroke:
    """A probe pressed on the gel and drawn over it."""

    name: str  # probe, batch and number
    probe: str  # sphere, sharp or flat
    clip: TouchClip  # all images of the batch
    rows: Int64[np.ndarray, " n"]  # indices of the stroke's images among them, in time
    force: Float64[np.ndarray, "n 3"]  # N; two along the gel, the third into it, + under pressure
    slip: Bool[np.ndarray, " n"]  # whether the probe slides
    untouched: int  # index of the last image without contact before the stroke

    def frames(self) -> UInt8[np.ndarray, "n h w 3"]:
        """Decode the stroke's RGB images."""
        return self.clip.frames(self.rows)

    def background(self) -> UInt8[np.ndarray, "h w 3"]:
        """Decode the image of the sensor without contact."""
        return self.clip.frames([self.untouched])[0]


def read_strokes(folder: Path, sensor: str | None = None) -> Iterator[ForceStroke]:
    """Read the strokes in a folder (a published set, a probe or a batch), one batch at a time.

    UserError: no such files, another sensor's, or a content that is not as published.
    """
    depths = ("", "*/", "*/*/")
    found = {p.parent for depth in depths for p in folder.glob(f"{depth}dataset_*.pkl")}
    batches = sorted(batch for batch in found if _shards(batch) or (batch / _LABELS).exists())
    if not batches:
        raise UserError(
            f"{folder} holds no PROBE/BATCH/dataset_digit_00.pkl or dataset_gelsight_00.pkl: give a "
            "folder of TacBench's force estimation"
        )
    for batch in batches:
        yield from _read_batch(batch, sensor)


def _shards(batch: Path) -> list[Path]:
    return sorted(path for path in batch.glob("dataset_*.pkl") if _IMAGES.fullmatch(path.name))


def _read_batch(batch: Path, sensor: str | None) -> Iterator[ForceStroke]:
    shards = _shards(batch)
    kinds = {match[1] for path in shards if (match := _IMAGES.fullmatch(path.name))}
    if len(kinds) != 1:
        what = "images of two sensors" if kinds else "no images (dataset_digit_00.pkl)"
        raise UserError(f"{batch} holds {what}: get it again, as published")
    if not (batch / _LABELS).is_file():
        raise UserError(f"{batch / _LABELS} is missing, which labels the images beside it")
    named = check_sensor(sensor, _KINDS[kinds.pop()], batch)
    images = [image for path in shards for image in read_images(path)]
    labels = read_plain_pickle(batch / _LABELS)
    name = str(batch / _LABELS)
    touched = booleans(entry(labels, "in_contact", name), f"'in_contact' of {name}")
    if len(touched) != len(images):
        raise UserError(
            f"{batch} holds {len(images)} images, {_LABELS} labels {len(touched)}: get all its files"
        )
    if touched.all():
        raise UserError(f"no image in {batch} is labelled as without contact: get it again")
    untouched = np.flatnonzero(~touched)
    clip = _with_true_colours(TouchClip(str(batch), named, images), int(untouched[0]))
    strokes = list(_trajectories(labels, name, len(images)))
    pressed = np.concatenate([force[:, 2] for _, _, force, _ in strokes] or [np.zeros(0)])
    into_gel = np.array([1.0, 1.0, -1.0 if pressed.sum() < 0 else 1.0])
    probe = re.sub(r"\d+$", "", batch.resolve().parent.name)
    for key, rows, force, slip in strokes:
        last = untouched[max(np.searchsorted(untouched, rows[0]) - 1, 0)]
        title = f"{batch.resolve().parent.name}/{batch.name}/{key}"
        yield ForceStroke(title, probe, clip, rows, force * into_gel, slip, int(last))


def _trajectories(labels: Any, name: str, images: int) -> Iterator[tuple[str, Any, Any, Any]]:
    trajectories = entry(labels, "trajectories", name)
    if not isinstance(trajectories, dict) or not trajectories:
        raise UserError(
            f"{name} has no stroke among its 'trajectories': get it again, as published"
        )
    for number, stroke in trajectories.items():
        key = str(number).encode("unicode_escape").decode()[:_MOST_NAME]
        own = f"of stroke {key} in {name}"
        force = numbers(
            entry(stroke, "forces", f"stroke {key} in {name}"),
            (None, 3),
            _MOST_FORCE,
            f"forces {own}",
        )
        n = len(force)
        rows = whole_numbers(entry(stroke, "indexes", own), images - 1, f"indexes {own}")
        slip = booleans(entry(stroke, "slip_label", own), f"slip labels {own}")
        if len(rows) not in (n, n + STRIDE) or len(slip) < n:
            raise UserError(
                f"stroke {key} in {name} has {len(rows)} images, {n} forces and {len(slip)} slip "
                "labels: get it again, as published"
            )
        if n:
            yield key, rows[:n], force, slip[:n]


def _with_true_colours(clip: TouchClip, untouched: int) -> TouchClip:
    """Exchange red and blue where the untouched gel is bluer than red; see the module."""
    if clip.sensor == "digit":
        return clip
    red, _, blue = clip.frames([untouched])[0].mean((0, 1))
    return replace(clip, red_and_blue_exchanged=bool(blue > red))

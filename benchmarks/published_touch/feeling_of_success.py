"""Grasp outcomes with two tactile sensors: The Feeling of Success (Calandra et al., CoRL 2017).

Layout of Sparsh's converter, T4 of TacBench (arXiv 2410.24090, C.6): files `000.pkl` to `035.pkl`, each a
dictionary of lists with one entry per grasp: `object_name`, `is_gripping`, and `gelsightA_before`,
`..._during`, `..._after`, and the same of B, encoded images. The converter gave RGB to OpenCV's writer,
which takes BGR, so red and blue are exchanged back here. Published split: files 000 to 029 are for training.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.published_touch.labels import booleans, entry
from touchgoal.episodes.importers.plain_pickle import read_plain_pickle
from touchgoal.episodes.importers.touch_clip import TouchClip, encoded_images
from touchgoal.runtime.errors import UserError

MOMENTS = ("before", "during", "after")
"""Moments of a grasp with an image: hand open, hand closed, object lifted."""
_FIRST_HELD_OUT = 30
_MAX_NAME = 200  # letters


@dataclass(frozen=True, eq=False)
class GraspTrial:
    """One grasp."""

    name: str  # name for messages
    object: str  # name of the object
    held: bool  # whether it was still in the hand after lifting
    held_out: bool  # whether it belongs to the published test files
    fingers: tuple[TouchClip, TouchClip]  # each one's images at `MOMENTS`, the first untouched


def read_grasps(folder: Path) -> Iterator[GraspTrial]:
    """Read the grasps of a folder, one file at a time.

    UserError: no such files, or a content that is not as published.
    """
    paths = _files(folder)
    if not paths:
        raise UserError(
            f"{folder} holds no 000.pkl to 035.pkl: give a folder of Feeling of Success"
        )
    for path in paths:
        yield from _read(path)


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("*.pkl") if re.fullmatch(r"\d{3}\.pkl", p.name))


def _read(path: Path) -> Iterator[GraspTrial]:
    value = read_plain_pickle(path)
    held = booleans(_plain(entry(value, "is_gripping", str(path))), f"'is_gripping' of {path}")
    names = _plain(entry(value, "object_name", str(path)))
    columns = {
        (finger, moment): encoded_images(entry(value, key, str(path)), f"'{key}' of {path}")
        for finger in "AB"
        for moment in MOMENTS
        for key in [f"gelsight{finger}_{moment}"]
    }
    if len({len(held), len(names), *map(len, columns.values())}) > 1:
        raise UserError(f"the lists in {path} are of different lengths: get it again, as published")
    held_out = int(path.stem) >= _FIRST_HELD_OUT
    for i, (name, holds) in enumerate(zip(names, held, strict=True)):
        title = f"{path} grasp {i}"
        first, second = (
            TouchClip(f"{title} ({f})", "gelsight", [columns[f, m][i] for m in MOMENTS], True)
            for f in "AB"
        )
        yield GraspTrial(title, _text(name, title), bool(holds), held_out, (first, second))


def _plain(value: Any) -> list[Any]:
    """Return a list or an array's row, with arrays of one number as that number."""
    items = list(value) if isinstance(value, list) or getattr(value, "ndim", 0) == 1 else []
    return [x.reshape(-1)[0] if isinstance(x, np.ndarray) and x.size == 1 else x for x in items]


def _text(value: Any, name: str) -> str:
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    if not isinstance(value, str) or len(value) > _MAX_NAME:
        raise UserError(f"{name} does not name its object: get the file again, as published")
    return str(value)

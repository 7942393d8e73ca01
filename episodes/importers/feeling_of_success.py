"""Grasps that held or failed, felt by two fingertips: The Feeling of Success (Calandra et al., CoRL 2017).

As Sparsh's converter leaves it, T4 of TacBench (arXiv 2410.24090, C.6): files `000.pkl` to `035.pkl`, each a
dictionary of lists, one entry a grasp: `object_name`, `is_gripping`, and `gelsightA_before`, `..._during`,
`..._after`, and the same of B, encoded pictures. The converter gave RGB to OpenCV's writer, which takes BGR,
so red and blue are exchanged back here; that the arrays it had were RGB is how others show them. Published
split: files 000 to 029 are learned from.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.episodes.importers.labels import entry, truths
from touchgoal.episodes.importers.plain_pickle import StoredBytes, read_plain_pickle
from touchgoal.episodes.importers.touch_clip import TouchClip, check_kind, stored_pictures
from touchgoal.runtime.errors import UserError

MOMENTS = ("before", "during", "after")
"""Pictures of a grasp: of the open hand, of the closed one, and of the lifted one."""
_FIRST_HELD_OUT = 30
_MOST_NAME = 200


@dataclass(frozen=True, eq=False)
class GraspTrial:
    """One grasp.

    Attributes:
        name: for messages.
        object: what was grasped.
        held: whether it was still in the hand after lifting.
        held_out: of the published test files.
        fingers: of each fingertip its pictures at `MOMENTS`, the first untouched.
    """

    name: str
    object: str
    held: bool
    held_out: bool
    fingers: tuple[TouchClip, TouchClip]


def read_grasps(folder: Path, sensor: str | None = None) -> Iterator[GraspTrial]:
    """The grasps of a folder, one file at a time.

    Raises:
        UserError: no such files, another sensor's, or what they hold is not as published.
    """
    paths = _files(folder)
    if not paths:
        raise UserError(
            f"{folder} holds no 000.pkl to 035.pkl: give a folder of Feeling of Success"
        )
    named = check_kind(sensor, ("gelsight", "gelsight_markers"), folder)
    for path in paths:
        yield from _read(path, named)


def is_grasp_set(folder: Path) -> bool:
    """Whether a folder holds files of these names."""
    return bool(_files(folder))


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("*.pkl") if re.fullmatch(r"\d{3}\.pkl", p.name))


def _read(path: Path, sensor: str) -> Iterator[GraspTrial]:
    value = read_plain_pickle(path)
    held = truths(_plain(entry(value, "is_gripping", str(path))), f"'is_gripping' of {path}")
    names = _plain(entry(value, "object_name", str(path)))
    columns = {
        (finger, moment): stored_pictures(
            entry(value, f"gelsight{finger}_{moment}", str(path)),
            f"'gelsight{finger}_{moment}' of {path}",
        )
        for finger in "AB"
        for moment in MOMENTS
    }
    lengths = {len(held), len(names), *map(len, columns.values())}
    if len(lengths) > 1:
        raise UserError(f"the lists in {path} are of different lengths: get it again, as published")
    for i, (name, holds) in enumerate(zip(names, held, strict=True)):
        title = f"{path} grasp {i}"
        first, second = (
            TouchClip(
                f"{title} ({finger})",
                sensor,
                [columns[finger, moment][i] for moment in MOMENTS],
                True,
            )
            for finger in "AB"
        )
        held_out = int(path.stem) >= _FIRST_HELD_OUT
        yield GraspTrial(title, _text(name, title), bool(holds), held_out, (first, second))


def _plain(value: Any) -> list[Any]:
    """A list or a row of an array; numbers in arrays of their own are taken out."""
    items = list(value) if isinstance(value, list) or getattr(value, "ndim", 0) == 1 else []
    return [x.reshape(-1)[0] if isinstance(x, np.ndarray) and x.size == 1 else x for x in items]


def _text(value: Any, name: str) -> str:
    """Text, as bytes of UTF-8 too."""
    if isinstance(value, StoredBytes):
        value = value.read() if value.size <= _MOST_NAME else None
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    if not isinstance(value, str) or len(value) > _MOST_NAME:
        raise UserError(f"{name} does not name its object: get the file again, as published")
    return str(value)

"""How an object moves under a finger: T3 of TacBench (Sparsh, arXiv 2410.24090, C.5).

The set `digit-pose-estimation`: `train/OBJECT/bag_NN.pkl` and `test/OBJECT/bag_NN.pkl`, each a dictionary
with `digit_FINGER`, a list of encoded pictures (index, middle, ring), and `object_FINGER_rel_pose_n5`,
(n, 4, 4), the object's motion relative to that finger within the last five of them; `bgs/digit_FINGER.png` is
each finger untouched.

Shifts are taken for millimetres: Sparsh sorts them by 0.1 to 5 without converting, and so the paper draws
them, but no page states the unit. Along "x", as Sparsh and the paper call it, is the matrix's second row,
along "y" its first; the turn is that about its third axis.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, UInt8

from touchgoal.episodes.importers.labels import entry, numbers
from touchgoal.episodes.importers.plain_pickle import read_plain_pickle
from touchgoal.episodes.importers.touch_clip import (
    TouchClip,
    check_kind,
    read_picture_file,
    stored_pictures,
)
from touchgoal.runtime.errors import UserError

STRIDE = 5
"""Pictures over which a motion is measured."""
Finger = Literal["index", "middle", "ring"]
_MILLIMETRE = 1e-3
_MOST_SHIFT = 1000.0  # in the file's unit
_OFF_ROTATION = 1e-2


@dataclass(frozen=True, eq=False)
class PoseBag:
    """One recording of an object moved by hand under a finger.

    Attributes:
        name: for messages.
        object: sugar or pringles.
        held_out: of the published test set.
        clip: its pictures.
        change: of the object's pose since `STRIDE` pictures before (m along x and y, rad), one a picture;
            the first `STRIDE` have no such past.
        untouched: file of the finger untouched.
    """

    name: str
    object: str
    held_out: bool
    clip: TouchClip
    change: Float64[np.ndarray, "n 3"]
    untouched: Path

    def background(self) -> UInt8[np.ndarray, "h w 3"]:
        """The finger untouched."""
        return read_picture_file(self.untouched, self.clip.sensor)


def read_bags(
    folder: Path, finger: Finger = "ring", sensor: str | None = None
) -> Iterator[PoseBag]:
    """The recordings of a published folder, one at a time.

    Args:
        folder: with train/ and test/.
        finger: which; the paper's is the ring finger.
        sensor: what recorded it: a DIGIT.

    Raises:
        UserError: no such files, another sensor's, or what they hold is not as published.
    """
    paths = _bags(folder)
    if not paths:
        raise UserError(
            f"{folder} holds no train/OBJECT/bag_00.pkl: give the folder of TacBench's pose estimation"
        )
    named = check_kind(sensor, ("digit",), folder)
    untouched = folder / "bgs" / f"digit_{finger}.png"
    if not untouched.is_file():
        raise UserError(f"{untouched} is missing, which shows the {finger} finger untouched")
    for path in paths:
        bag = read_plain_pickle(path)
        key = f"digit_{finger}"
        pictures = stored_pictures(entry(bag, key, str(path)), f"'{key}' of {path}")
        change = _planar(entry(bag, f"object_{finger}_rel_pose_n{STRIDE}", str(path)), str(path))
        count = min(len(pictures), len(change))
        clip = TouchClip(f"{path} ({finger})", named, pictures[:count])
        held_out = path.parent.parent.name == "test"
        yield PoseBag(str(path), path.parent.name, held_out, clip, change[:count], untouched)


def is_pose_set(folder: Path) -> bool:
    """Whether a folder holds these files."""
    return bool(_bags(folder))


def _bags(folder: Path) -> list[Path]:
    found = [path for use in ("train", "test") for path in sorted(folder.glob(f"{use}/*/*.pkl"))]
    return [path for path in found if re.fullmatch(r"bag_\d+\.pkl", path.name)]


def _planar(value: object, name: str) -> Float64[np.ndarray, "n 3"]:
    pose = numbers(value, (None, 4, 4), _MOST_SHIFT, f"poses of {name}")
    turn = pose[:, :3, :3]
    off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(initial=0)
    if off > _OFF_ROTATION or not np.allclose(pose[:, 3], (0, 0, 0, 1), atol=1e-6):
        raise UserError(f"poses of {name} are no rigid motions: get it again, as published")
    yaw = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    return np.column_stack([_MILLIMETRE * pose[:, 1, 3], _MILLIMETRE * pose[:, 0, 3], yaw])

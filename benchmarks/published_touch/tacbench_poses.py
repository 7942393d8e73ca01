"""Relative object pose under a finger: T3 of TacBench (Sparsh, arXiv 2410.24090, C.5).

The set `digit-pose-estimation` holds `train/OBJECT/bag_NN.pkl` and `test/OBJECT/bag_NN.pkl`, each a
dictionary with `digit_FINGER`, a list of encoded images (index, middle, ring), and
`object_FINGER_rel_pose_n5`, (n, 4, 4), the object's motion relative to that finger over the last five
images; `bgs/digit_FINGER.png` shows each finger without contact.

Translations are taken for millimetres: Sparsh bins them from 0.1 to 5 without conversion, as the paper plots
them; no source states the unit. Sparsh's "x" is the matrix's second row, "y" its first; the rotation is that
about the third axis.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from benchmarks.published_touch.labels import entry, numbers
from touchgoal.episodes.importers.plain_pickle import read_plain_pickle
from touchgoal.episodes.importers.touch_clip import TouchClip, encoded_images, read_image_file
from touchgoal.runtime.errors import UserError

STRIDE = 5  # number of images over which a motion is measured
_IMAGES = "digit_ring"  # the finger that the paper uses
_MILLIMETRE = 1e-3
_MOST_SHIFT = 1000.0  # in the file's unit
_OFF_ROTATION = 1e-2


@dataclass(frozen=True, eq=False)
class PoseBag:
    """One recording of an object moved by hand under a finger."""

    name: str  # name for messages
    object: str  # sugar or pringles
    held_out: bool  # whether it belongs to the published test set
    clip: TouchClip  # images
    # change of the object's pose over the last `STRIDE` images (m along x and y, rad), one row
    # per image; the first `STRIDE` rows have no such past
    change: Float64[np.ndarray, "n 3"]
    untouched: Path  # image file of the finger without contact

    def background(self) -> UInt8[np.ndarray, "h w 3"]:
        """Read the image of the finger without contact."""
        return read_image_file(self.untouched, self.clip.sensor)


def read_bags(folder: Path) -> Iterator[PoseBag]:
    """Read the recordings of the ring finger in a published folder (train/, test/), one at a time.

    UserError: no such files, or a content that is not as published.
    """
    paths = _bags(folder)
    if not paths:
        raise UserError(
            f"{folder} holds no train/OBJECT/bag_00.pkl: give the folder of TacBench's pose estimation"
        )
    untouched = folder / "bgs" / f"{_IMAGES}.png"
    if not untouched.is_file():
        raise UserError(f"{untouched} is missing, which shows the ring finger without contact")
    for path in paths:
        bag = read_plain_pickle(path)
        images = encoded_images(entry(bag, _IMAGES, str(path)), f"'{_IMAGES}' of {path}")
        change = _planar(entry(bag, f"object_ring_rel_pose_n{STRIDE}", str(path)), str(path))
        count = min(len(images), len(change))
        clip = TouchClip(str(path), "digit", images[:count])
        held_out = path.parent.parent.name == "test"
        yield PoseBag(str(path), path.parent.name, held_out, clip, change[:count], untouched)


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

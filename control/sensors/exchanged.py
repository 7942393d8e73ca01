"""Exchanged cameras and fingertips, found by their images."""

import time
from collections.abc import Callable, Mapping

import cv2
import numpy as np

from touchgoal.control.arrays import Image
from touchgoal.control.interfaces import TactileSensor
from touchgoal.control.tactile.background import Background, local_change
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.runtime.errors import UserError

_CLEARLY = 1.5  # factor by which a fingertip must be more like the other's sensor file
_SMALL = 32  # px of a side at which images of cameras are compared
_MOVED = 2.5  # counts: median change of an image whose camera has moved, at least
_LOOKS, _LOOK = 600, 0.05  # times that a fingertip is looked at for a touch, and s between two
_TIMES = 3.0  # factor by which the other camera's image must change less


def fingertips_exchanged(frames: tuple[Image, Image], backgrounds: tuple[Image, Image]) -> bool:
    """Return whether two untouched fingertips each look more like the other's sensor file.

    Both must, because light drifts and a file may be old. Frames and backgrounds are left, then
    right.
    """
    unlike = [
        [float(local_change(frame, background).mean()) for background in backgrounds]
        for frame in frames
    ]
    return all(_CLEARLY * unlike[side][1 - side] < unlike[side][side] for side in (0, 1))


def probe_fingertips(
    tips: Mapping[str, TactileSensor],
    say: Callable[[str], None] = print,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Ask for a touch of each fingertip by its name; UserError if another one answers, or none."""
    detectors = {n: ContactDetector(Background(tip.read().image[None])) for n, tip in tips.items()}
    for asked in tips:
        say(f"touch the {asked} fingertip, then let go")
        felt = False
        for _ in range(_LOOKS):
            wait(_LOOK)
            touched = [n for n, tip in tips.items() if detectors[n].update(tip.read().image)]
            if touched and asked not in touched:
                raise UserError(
                    f"the {touched[0]} fingertip felt the touch of the {asked} one: exchange them in "
                    "the cell file, or the two sensors"
                )
            if felt and not touched:
                break
            felt = felt or asked in touched
        else:
            raise UserError(f"the {asked} fingertip felt no touch: check its cable and its gel")


def cameras_exchanged(front: tuple[Image, Image], wrist: tuple[Image, Image]) -> bool:
    """Return whether the front camera has moved with the arm and the wrist camera has not.

    False for a view without structure; the images are from before and after a move of the arm.
    """
    moved = _median_change(*front)
    return moved > _MOVED and moved > _TIMES * _median_change(*wrist)


def _median_change(before: Image, after: Image) -> float:
    """Return the median change of the pixels after a common gain (exposure), counts."""
    size = _SMALL, _SMALL
    small = [cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (before, after)]
    first, second = (x.astype(np.float32) for x in small)
    gain = np.median(second, axis=(0, 1)) / np.maximum(np.median(first, axis=(0, 1)), 1.0)
    return float(np.median(np.abs(second - gain * first).max(2)))

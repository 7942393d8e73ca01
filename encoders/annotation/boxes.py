"""Boxes in an image: overlap, crops, and where a box goes in a video."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control.arrays import Image

Box = tuple[float, float, float, float]
"""Left, top, right, bottom, px; right and bottom are excluded."""

_GREY = (128, 128, 128)


@dataclass(frozen=True)
class Detection:
    """A box in an image."""

    box: Box  # in px
    score: float  # confidence of the detector, in [0, 1]


def area(box: Box) -> float:
    """Return the area of a box in px^2; 0 if it is turned inside out."""
    return max(box[2] - box[0], 0.0) * max(box[3] - box[1], 0.0)


def intersection(one: Box, other: Box) -> float:
    """Return the common area of two boxes in px^2."""
    left, top = max(one[0], other[0]), max(one[1], other[1])
    return area((left, top, min(one[2], other[2]), min(one[3], other[3])))


def iou(one: Box, other: Box) -> float:
    """Return the intersection over union of two boxes, in [0, 1]."""
    common = intersection(one, other)
    union = area(one) + area(other) - common
    return common / union if union > 0 else 0.0


def clipped(box: Box, image: Image) -> Box:
    """Return the part of a box that lies in an image."""
    height, width = image.shape[:2]
    left, right = (min(max(x, 0.0), float(width)) for x in (box[0], box[2]))
    top, bottom = (min(max(y, 0.0), float(height)) for y in (box[1], box[3]))
    return left, top, right, bottom


def crop(image: Image, box: Box) -> UInt8[np.ndarray, "y x 3"]:
    """Return the pixels of a box, at least one; the box must reach into the image."""
    left, top, right, bottom = clipped(box, image)
    x = min(int(left), image.shape[1] - 1)
    y = min(int(top), image.shape[0] - 1)
    return image[y : max(round(bottom), y + 1), x : max(round(right), x + 1)]


def square_crop(image: Image, box: Box, size: int) -> UInt8[np.ndarray, "size size 3"]:
    """Return the pixels of a box in the middle of a grey square of `size` px."""
    pixels = crop(image, box)
    scale = size / max(pixels.shape[:2])
    height, width = (max(round(n * scale), 1) for n in pixels.shape[:2])
    smaller = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(pixels, (width, height), interpolation=smaller)
    top, left = (size - height) // 2, (size - width) // 2
    sides = top, size - height - top, left, size - width - left
    return cv2.copyMakeBorder(resized, *sides, cv2.BORDER_CONSTANT, value=_GREY)


TRACKER = f"CSRT of OpenCV {cv2.__version__}"


def track_csrt(frames: Iterable[Image], box: Box) -> list[Box | None]:
    """Follow what a box shows in the first frame (CSRT, Lukezic et al., CVPR 2017).

    Args:
        frames: RGB images of one size, in time.
        box: In the first frame.

    Returns:
        One box for each frame, clipped to the image; None where the tracker lost it, and ever after.
    """
    boxes: list[Box | None] = []
    tracker = cv2.TrackerCSRT.create()
    for image in frames:
        bgr = np.ascontiguousarray(image[:, :, ::-1])
        if not boxes:
            left, top, right, bottom = (round(x) for x in clipped(box, image))
            tracker.init(bgr, (left, top, right - left, bottom - top))
            boxes.append(box)
        elif boxes[-1] is None:
            boxes.append(None)
        else:
            found, (x, y, width, height) = tracker.update(bgr)
            new = clipped((float(x), float(y), float(x + width), float(y + height)), image)
            boxes.append(new if found and area(new) else None)
    return boxes

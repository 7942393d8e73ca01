"""Tracking of the sensor in the camera images: from a first box, by OpenCV's CSRT."""

from collections.abc import Iterable

import cv2
import numpy as np

from touchgoal.encoders.annotation.boxes import Box, Image, area, clipped

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

"""Matching, MMWand, appendix A: frames of a recording, and the object that the sensor touches.

The contact frame maximises the norm of the pixel difference to the untouched tactile frame; the
reference frame is the first camera frame before it that shows the object unobstructed.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from touchgoal.encoders.annotation.boxes import Box, Detection, Image, intersection, iou
from touchgoal.encoders.annotation.records import LeftOut

_UNTOUCHED = 5  # frames of a recording closest to the reference, taken as untouched


@dataclass(frozen=True)
class ContactFrame:
    """Frame of the largest deformation."""

    index: int  # index of the frame
    deformation: float  # norm of its difference to the reference frame, counts
    threshold: float  # smallest norm that counts as contact, counts


def match_contact(
    touches: Iterable[Image], reference: Image, min_deformation: float
) -> ContactFrame:
    """Return the contact frame of a recording.

    Noise alone puts every untouched frame at nearly the same distance from the reference. The threshold
    is `min_deformation` times the median distance of the 5 frames closest to the reference.

    LeftOut: too few frames are active, or none is deformed enough.

    Args:
        touches: Tactile frames in time.
        reference: Tactile frame without contact.
        min_deformation: Factor of the untouched frames' distance, above 1.
    """
    distances = deformations(touches, reference)
    active = np.flatnonzero(np.isfinite(distances))
    if len(active) <= _UNTOUCHED:
        raise LeftOut("fewer than 6 active tactile frames")
    untouched = np.sort(distances[active])[:_UNTOUCHED]
    threshold = min_deformation * float(np.median(untouched))
    index = int(active[distances[active].argmax()])
    if distances[index] <= threshold:
        raise LeftOut("not enough deformation: the sensor touches nothing")
    return ContactFrame(index, float(distances[index]), threshold)


def deformations(touches: Iterable[Image], reference: Image) -> Float[np.ndarray, " n"]:
    """Return the norm of each frame's difference to the reference, counts; NaN for inactive frames.

    A frame is inactive if it has one colour, or repeats the reference or the frame before it.

    LeftOut: a frame has another size than the reference.
    """
    distances, before = [], reference
    for touch in touches:
        if touch.shape != reference.shape:
            raise LeftOut("tactile frames of different sizes")
        inactive = np.array_equal(touch, before) or np.array_equal(touch, reference)
        inactive = inactive or bool((touch == touch[0, 0]).all())
        difference = np.subtract(touch, reference, dtype=np.float32)
        distances.append(np.nan if inactive else float(np.linalg.norm(difference)))
        before = touch
    return np.asarray(distances, np.float64)


def match_reference(sensor: Sequence[Box | None]) -> int:
    """Return the first frame in which the sensor does not cover the place that it will touch.

    LeftOut: the sensor is lost at the contact, or covers the place in every frame.

    Args:
        sensor: The sensor's box in each camera frame up to the contact frame, the last; None where it is
            not in view.
    """
    contact = sensor[-1]
    if contact is None:
        raise LeftOut("the tracker lost the sensor before the contact")
    for i, box in enumerate(sensor):
        if box is None or not intersection(box, contact):
            return i
    raise LeftOut("the sensor hides the touched place in every frame before the contact")


_SAME_OBJECT = 0.7  # IoU of two boxes of one object
_SAME_AS_SENSOR = 0.5  # IoU of a box with the sensor's


def select_instances(
    detections: Sequence[Detection], sensor: Box | None, min_score: float
) -> tuple[list[Detection], dict[str, int]]:
    """Return the objects among the detections, best first, and how many were dropped for what reason.

    LeftOut: no object remains.

    Args:
        detections: Boxes in the reference frame.
        sensor: The sensor's box in the reference frame; None if it is not in view.
        min_score: Smallest confidence.
    """
    kept: list[Detection] = []
    dropped: Counter[str] = Counter()
    for found in sorted(detections, key=lambda d: -d.score):
        if found.score < min_score:
            dropped["low confidence"] += 1
        elif sensor is not None and iou(found.box, sensor) > _SAME_AS_SENSOR:
            dropped["the sensor itself"] += 1
        elif any(iou(found.box, other.box) > _SAME_OBJECT for other in kept):
            dropped["detected twice"] += 1
        else:
            kept.append(found)
    if not kept:
        raise LeftOut("low confidence: no object was detected")
    return kept, dict(dropped)


def match_instance(
    instances: Sequence[Detection], sensor: Box, min_overlap: float
) -> tuple[int, float]:
    """Return the index of the touched object and its IoU with the sensor's box at the contact.

    LeftOut: no object overlaps the sensor enough.
    """
    overlaps = [iou(instance.box, sensor) for instance in instances]
    touched = max(range(len(overlaps)), key=overlaps.__getitem__)
    if overlaps[touched] < min_overlap:
        raise LeftOut("low overlap: no detected object is where the sensor touches")
    return touched, overlaps[touched]

"""Instance matching: which detected object the sensor touches (MMWand, appendix A)."""

from collections import Counter
from collections.abc import Sequence

from touchgoal.encoders.annotation.boxes import Box, Detection, iou
from touchgoal.encoders.annotation.records import LeftOut

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

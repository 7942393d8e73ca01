"""Annotation of recordings (MMWand, appendix A): which object is touched, and a caption for every one in view.

The contact frame maximises the norm of the pixel difference to the untouched tactile frame; the
reference frame is the first camera frame before it that shows the object unobstructed.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from touchgoal.control.arrays import Image
from touchgoal.encoders.annotation import records
from touchgoal.encoders.annotation.boxes import (
    Box,
    Detection,
    crop,
    intersection,
    iou,
    track_csrt,
)
from touchgoal.encoders.annotation.config import AnnotationSettings
from touchgoal.encoders.annotation.models import AnnotationModels
from touchgoal.episodes.importers.visgel import VisGelRecording
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image
from touchgoal.runtime.progress import track

ANNOTATIONS, LEFT_OUT = "annotations.jsonl", "left_out.jsonl"
_SENSOR_SOUGHT = 5  # first frames in which the sensor is looked for: the reference may not show it

_CAPTION_PROMPT = "What specific object is presented in the scene?"  # MMWand, appendix A


def annotate_all(
    recordings: Sequence[VisGelRecording],
    root: Path,
    models: AnnotationModels,
    settings: AnnotationSettings,
    out: Path,
) -> dict[str, Any]:
    """Annotate the recordings, whose paths are relative to `root`, that `out` does not hold yet.

    Writes one line per recording to `annotations.jsonl`, or with the reason to `left_out.jsonl`. Returns
    numbers over all lines: `recordings`, `annotated`, `left_out` by reason, `instances`, and `dropped`
    boxes by reason.

    UserError: a line is broken, or the lines were made by other models or settings.
    """
    provenance = {**models.names, **settings.as_json()}
    annotated = records.LinesFile(out / ANNOTATIONS, records.AnnotatedTouch)
    left_out = records.LinesFile(out / LEFT_OUT, records.LeftOutRecording)
    for file in (annotated, left_out):
        file.remove_unfinished()
    done = _finished(annotated, left_out, provenance)
    todo = [recording for recording in recordings if recording.name not in done]
    for recording in track(todo, "annotating", "recording"):
        try:
            annotated.append(annotate(recording, root, models, settings, provenance))
        except records.LeftOut as reason:
            left_out.append(records.LeftOutRecording(recording.name, str(reason), provenance))
    return _summary(list(annotated.read()), list(left_out.read()))


def annotate(
    recording: VisGelRecording,
    root: Path,
    models: AnnotationModels,
    settings: AnnotationSettings,
    provenance: dict[str, Any],
) -> records.AnnotatedTouch:
    """Match the frames and the instance of one recording, and caption what is in view.

    LeftOut: it cannot be annotated.
    """
    touches = (_read(root / touch) for _, touch in recording.steps)
    reference_touch = root / recording.reference[1]
    index, deformation, threshold = match_contact(touches, _read(reference_touch))
    contact_image, touch = recording.steps[index]
    video = _video_until(recording, contact_image)
    sensor = _track_sensor([root / name for name in video], models, settings)
    chosen = match_reference(sensor)
    at_contact = sensor[-1]
    assert at_contact is not None  # match_reference has checked it
    image = _read(root / video[chosen])
    detections = models.detect(image, "object")
    kept, dropped = select_instances(detections, sensor[chosen], settings.min_score)
    touched, overlap = match_instance(kept, at_contact, settings.min_overlap)
    instances = tuple(
        records.Instance(d.box, d.score, models.caption(crop(image, d.box), _CAPTION_PROMPT))
        for d in kept
    )
    if not instances[touched].caption:
        raise records.LeftOut("empty caption of the touched object")
    return records.AnnotatedTouch(
        name=recording.name,
        touch=_absolute(root / touch),
        reference_touch=_absolute(reference_touch),
        image=_absolute(root / video[chosen]),
        instances=instances,
        touched=touched,
        overlap=overlap,
        object=instances[touched].caption,
        dropped=dropped,
        contact=records.Contact(
            _absolute(root / contact_image), at_contact, deformation, threshold
        ),
        provenance=provenance,
    )


def _video_until(recording: VisGelRecording, contact_image: str) -> list[str]:
    """Return the camera images from the reference to the contact, in time."""
    video = recording.video[: recording.video.index(contact_image) + 1]
    reference = recording.reference[0]
    return [reference, *(name for name in video if name != reference)]


def _track_sensor(
    paths: Sequence[Path], models: AnnotationModels, settings: AnnotationSettings
) -> list[Box | None]:
    """Return the sensor's box in each camera image; None before the first in which it is seen."""
    for first, path in enumerate(paths[:_SENSOR_SOUGHT]):
        box = settings.sensor_box
        if box is None:
            found = models.detect(_read(path), "robot gripper")
            sure = [d for d in found if d.score >= settings.min_score]
            box = max(sure, key=lambda d: d.score).box if sure else None
        if box is not None:
            return [None] * first + track_csrt(map(_read, paths[first:]), box)
    raise records.LeftOut("low confidence: the sensor was not detected")


def _read(path: Path) -> Image:
    image = read_image(path)
    if image is None:
        raise records.LeftOut("an image is missing or unreadable")
    return image


def _absolute(path: Path) -> str:
    return str(path.resolve())


def _finished(
    annotated: records.LinesFile[records.AnnotatedTouch],
    left_out: records.LinesFile[records.LeftOutRecording],
    provenance: dict[str, Any],
) -> set[str]:
    """Return the names of the recordings that need not be done again."""
    names = set()
    for file in (annotated, left_out):
        for line in file.read():
            if line.provenance != provenance:
                raise UserError(
                    f"{file.path} was made by other models or settings: choose another --out"
                )
            names.add(line.name)
    return names


def _summary(
    annotated: Sequence[records.AnnotatedTouch], left_out: Sequence[records.LeftOutRecording]
) -> dict[str, Any]:
    dropped: Counter[str] = Counter()
    for line in annotated:
        dropped.update(line.dropped)
    return {
        "recordings": len(annotated) + len(left_out),
        "annotated": len(annotated),
        "left_out": dict(Counter(line.reason for line in left_out)),
        "instances": sum(len(line.instances) for line in annotated),
        "dropped": dict(dropped),
    }


_UNTOUCHED = 5  # frames of a recording closest to the reference, taken as untouched
_MIN_DEFORMATION = 1.5  # least that counts as contact, times the untouched frames' noise


def match_contact(touches: Iterable[Image], reference: Image) -> tuple[int, float, float]:
    """Return the index of the contact frame, its norm, and the least norm of a contact, in counts.

    Norms are those of the difference to the reference, a frame without contact. Noise alone puts every
    untouched frame at nearly the same distance from it: the threshold is 1.5 times the median distance
    of the 5 frames closest to it.

    LeftOut: too few frames are active, or none is deformed enough.
    """
    distances = deformations(touches, reference)
    active = np.flatnonzero(np.isfinite(distances))
    if len(active) <= _UNTOUCHED:
        raise records.LeftOut("fewer than 6 active tactile frames")
    untouched = np.sort(distances[active])[:_UNTOUCHED]
    threshold = _MIN_DEFORMATION * float(np.median(untouched))
    index = int(active[distances[active].argmax()])
    if distances[index] <= threshold:
        raise records.LeftOut("not enough deformation: the sensor touches nothing")
    return index, float(distances[index]), threshold


def deformations(touches: Iterable[Image], reference: Image) -> Float[np.ndarray, " n"]:
    """Return the norm of each frame's difference to the reference, counts; NaN for inactive frames.

    A frame is inactive if it has one colour, or repeats the reference or the frame before it.

    LeftOut: a frame has another size than the reference.
    """
    distances, before = [], reference
    for touch in touches:
        if touch.shape != reference.shape:
            raise records.LeftOut("tactile frames of different sizes")
        inactive = np.array_equal(touch, before) or np.array_equal(touch, reference)
        inactive = inactive or bool((touch == touch[0, 0]).all())
        difference = np.subtract(touch, reference, dtype=np.float32)
        distances.append(np.nan if inactive else float(np.linalg.norm(difference)))
        before = touch
    return np.asarray(distances, np.float64)


def match_reference(sensor: Sequence[Box | None]) -> int:
    """Return the first frame in which the sensor does not cover the place that it will touch.

    `sensor` is its box in each camera frame up to the contact frame, the last; None where it is not in
    view. LeftOut: the sensor is lost at the contact, or covers the place in every frame.
    """
    contact = sensor[-1]
    if contact is None:
        raise records.LeftOut("the tracker lost the sensor before the contact")
    for i, box in enumerate(sensor):
        if box is None or not intersection(box, contact):
            return i
    raise records.LeftOut("the sensor hides the touched place in every frame before the contact")


_SAME_OBJECT = 0.7  # IoU of two boxes of one object
_SAME_AS_SENSOR = 0.5  # IoU of a box with the sensor's


def select_instances(
    detections: Sequence[Detection], sensor: Box | None, min_score: float
) -> tuple[list[Detection], dict[str, int]]:
    """Return the objects among the detections, best first, and how many were dropped for what reason.

    Boxes are in the reference frame; `sensor` is None if it is not in view. LeftOut: no object remains.
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
        raise records.LeftOut("low confidence: no object was detected")
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
        raise records.LeftOut("low overlap: no detected object is where the sensor touches")
    return touched, overlaps[touched]

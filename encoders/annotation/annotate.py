"""Annotation of recordings (MMWand, appendix A): which object is touched, and a caption for every one in view."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from touchgoal.encoders.annotation import matching, records
from touchgoal.encoders.annotation.boxes import Box, Image, crop, track_csrt
from touchgoal.encoders.annotation.config import AnnotationSettings
from touchgoal.encoders.annotation.models import AnnotationModels
from touchgoal.episodes.importers.visgel import VisGelRecording
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image
from touchgoal.runtime.progress import track

ANNOTATIONS, LEFT_OUT = "annotations.jsonl", "left_out.jsonl"
_SENSOR_SOUGHT = 5  # first frames in which the sensor is looked for: the reference may not show it

_MIN_DEFORMATION = 1.5  # least that counts as contact, times the untouched frames' noise
_CAPTION_PROMPT = "What specific object is presented in the scene?"  # MMWand, appendix A


def annotate_all(
    recordings: Sequence[VisGelRecording],
    root: Path,
    models: AnnotationModels,
    settings: AnnotationSettings,
    out: Path,
) -> dict[str, Any]:
    """Annotate the recordings that `out` does not hold yet.

    Writes one line per recording to `annotations.jsonl`, or with the reason to `left_out.jsonl`.

    UserError: a line is broken, or the lines were made by other models or settings.

    Args:
        root: Folder that their paths are relative to.
        out: Folder of the run, which exists.

    Returns:
        Numbers over all lines: `recordings`, `annotated`, `left_out` by reason, `instances`, and `dropped`
        boxes by reason.
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
    contact = matching.match_contact(touches, _read(reference_touch), _MIN_DEFORMATION)
    contact_image, touch = recording.steps[contact.index]
    video = _video_until(recording, contact_image)
    sensor = _track_sensor([root / name for name in video], models, settings)
    chosen = matching.match_reference(sensor)
    at_contact = sensor[-1]
    assert at_contact is not None  # match_reference has checked it
    image = _read(root / video[chosen])
    detections = models.detect(image, "object")
    kept, dropped = matching.select_instances(detections, sensor[chosen], settings.min_score)
    touched, overlap = matching.match_instance(kept, at_contact, settings.min_overlap)
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
            _absolute(root / contact_image), at_contact, contact.deformation, contact.threshold
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
        box = settings.sensor_box or _find_sensor(_read(path), models, settings)
        if box is not None:
            return [None] * first + track_csrt(map(_read, paths[first:]), box)
    raise records.LeftOut("low confidence: the sensor was not detected")


def _find_sensor(
    image: Image, models: AnnotationModels, settings: AnnotationSettings
) -> Box | None:
    found = models.detect(image, "robot gripper")
    best = max(found, key=lambda d: d.score, default=None)
    return best.box if best is not None and best.score >= settings.min_score else None


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

"""Touches to align from annotated records: one object for each caption of a touched instance."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control.tactile.sensor_models import find_model
from touchgoal.encoders.annotation.boxes import square_crop
from touchgoal.encoders.annotation.records import AnnotatedTouch, read_annotations
from touchgoal.episodes.importers.touch_clip import read_image_file
from touchgoal.episodes.touches import Touches
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image
from touchgoal.runtime.progress import track

_VIEW = 224  # px


def annotated_touches(records: Sequence[AnnotatedTouch], sensor: str) -> Touches:
    """Return the touches of n records: a frame in contact, its background and a view each.

    A touch's object is the record's `object`, case aside; its descriptions are the captions of the touched
    instances with that object. The view is the crop of the touched instance in a grey square of 224 px.
    Tactile images are turned and resized to the sensor's format.

    UserError: an unknown sensor, or an image is missing or broken.

    Args:
        records: As `read_annotations` returns them.
        sensor: Name of the fingertip sensor; VisGel's is gelsight_markers.
    """
    find_model(sensor)
    frames, backgrounds, views, objects = [], [], [], []
    descriptions: dict[str, dict[str, None]] = {}
    for record in track(records, "reading", "touch"):
        frames.append(_tactile(record.touch, sensor))
        backgrounds.append(_tactile(record.reference_touch, sensor))
        if (image := read_image(Path(record.image))) is None:
            raise UserError(f"{record.image} is missing or unreadable: annotate again")
        views.append(square_crop(image, record.instances[record.touched].box, _VIEW))
        objects.append(record.object.lower())
        caption = record.instances[record.touched].caption
        descriptions.setdefault(objects[-1], {}).setdefault(caption)
    index = np.arange(len(frames))
    return Touches(
        frames=np.stack(frames),
        background=np.stack(backgrounds),
        background_index=index,
        view=np.stack(views),
        view_index=index,
        object=tuple(objects),
        descriptions={name: list(captions) for name, captions in descriptions.items()},
    )


def open_annotations(data: Path, validation: Path, sensor: str | None) -> tuple[Touches, Touches]:
    """Return the touches of two files of `annotate`, for training and validation.

    UserError: no sensor is named, a file is broken, or both hold the same recording.
    """
    if sensor is None:
        raise UserError(f"{data} does not name its fingertip sensor: name it with --sensor")
    train, val = read_annotations(data), read_annotations(validation)
    if shared := {record.image for record in train} & {record.image for record in val}:
        raise UserError(
            f"{data} and {validation} share {len(shared)} recordings, such as that of {min(shared)}: "
            "validate on recordings that are not trained on"
        )
    return annotated_touches(train, sensor), annotated_touches(val, sensor)


def _tactile(path: str, sensor: str) -> UInt8[np.ndarray, "h w 3"]:
    height, width = find_model(sensor).image_shape
    frame = read_image_file(Path(path), sensor)
    return cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)

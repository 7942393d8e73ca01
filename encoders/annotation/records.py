"""Annotated touches as lines of a JSONL file: written one by one, so that a kill costs the last line at most.

Of such lines touches to align are made: an object for each caption of a touched instance.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from touchgoal.control.tactile.sensor_models import find_model
from touchgoal.encoders.annotation.boxes import Box, square_crop
from touchgoal.episodes.importers.touch_clip import read_image_file
from touchgoal.episodes.touches import Touches
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image
from touchgoal.runtime.option_types import STRICT, first_problem
from touchgoal.runtime.progress import track

_VIEW = 224  # px, of a view of a touched object


@dataclass(frozen=True, config=STRICT)
class Instance:
    """An object in view."""

    box: Box  # in the reference image, px
    score: float  # confidence of the detector
    caption: str  # answer of the captioner on the object's crop


@dataclass(frozen=True, config=STRICT)
class Contact:
    """The frame of the largest deformation."""

    image: str  # camera image of that time; the sensor hides the object
    sensor: Box  # the sensor's box in it, px
    deformation: float  # norm of the tactile frame's difference to the reference, counts
    threshold: float  # smallest norm that counts as contact, counts


@dataclass(frozen=True, config=STRICT)
class AnnotatedTouch:
    """One touch: a line of `annotations.jsonl`. Files are named by absolute paths."""

    name: str  # the recording
    touch: str  # tactile image of the contact
    reference_touch: str  # tactile image without contact
    image: str  # camera image in which the sensor does not hide the object
    # every object in view, by confidence
    instances: Annotated[tuple[Instance, ...], Field(min_length=1)]
    touched: Annotated[int, Field(ge=0)]  # index of the touched one
    overlap: float  # IoU of its box and the sensor's box at the contact
    object: str  # id of the touched object: its caption, or a person's correction of it
    dropped: dict[str, int]  # number of boxes that were not taken for objects, by reason
    contact: Contact
    provenance: dict[str, Any]  # models, thresholds and prompts

    def __post_init__(self) -> None:
        """Check the index of the touched instance."""
        if self.touched >= len(self.instances):
            raise ValueError(f"touched is {self.touched} of {len(self.instances)} instances")


class LeftOut(Exception):
    """A recording cannot be annotated; the message is one of a few fixed reasons."""


@dataclass(frozen=True, config=STRICT)
class LeftOutRecording:
    """A recording without annotation: a line of `left_out.jsonl`."""

    name: str
    reason: str
    provenance: dict[str, Any]


Line = TypeVar("Line", AnnotatedTouch, LeftOutRecording)


class LinesFile(Generic[Line]):
    """A JSONL file of records of one class, to which lines are appended; it need not exist."""

    def __init__(self, path: Path, kind: type[Line]) -> None:
        self.path, self._lines = path, TypeAdapter(kind)

    def read(self) -> Iterator[Line]:
        """Yield the records; UserError if a line is broken."""
        if not self.path.exists():
            return
        with self.path.open("rb") as lines:
            for number, line in enumerate(lines, 1):
                try:
                    yield self._lines.validate_json(line)
                except ValidationError as error:
                    raise UserError(
                        f"{self.path}:{number}: {first_problem(error)}; mend or delete the line"
                    ) from error

    def remove_unfinished(self) -> None:
        """Cut off a last line that a kill left unfinished."""
        if self.path.exists():
            data = self.path.read_bytes()
            if data and not data.endswith(b"\n"):
                with self.path.open("r+b") as file:
                    file.truncate(data.rfind(b"\n") + 1)

    def append(self, line: Line) -> None:
        """Write one more line, complete or not at all."""
        with self.path.open("ab") as file:
            file.write(self._lines.dump_json(line) + b"\n")


def read_annotations(path: Path) -> list[AnnotatedTouch]:
    """Read the records that `annotate` wrote.

    UserError: there is no such file, it is empty, or a line is broken.
    """
    records = list(LinesFile(path, AnnotatedTouch).read())
    if not records:
        raise UserError(f"{path} holds no annotated touch: give an annotations.jsonl of annotate")
    return records


def annotated_touches(records: Sequence[AnnotatedTouch], sensor: str) -> Touches:
    """Return the touches of n records: a frame in contact, its background and a view each.

    A touch's object is the record's `object`, case aside; its descriptions are the captions of the touched
    instances with that object. The view is the crop of the touched instance in a grey square of 224 px.
    Tactile images are turned and resized to the sensor's format.

    UserError: an unknown sensor (VisGel's is gelsight_markers), or an image is missing or broken.
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

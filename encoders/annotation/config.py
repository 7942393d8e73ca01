"""Options of the annotation; light to import, `--help` shows them."""

import json
from dataclasses import fields
from typing import Annotated, Any

from pydantic import Field

from touchgoal.runtime.option_types import Fraction, checked_dataclass


@checked_dataclass
class AnnotationSettings:
    """Prompts and thresholds."""

    object_prompt: str = "object"
    """Prompt of the detector for objects."""
    sensor_prompt: str = "robot gripper"
    """Prompt of the detector for the sensor in the first camera image."""
    sensor_box: tuple[float, float, float, float] | None = None
    """The sensor in the first camera image of every recording: left, top, right, bottom, px. Default: it
    is detected."""
    caption_prompt: str = "What specific object is presented in the scene?"
    """Prompt of the captioner, which sees the crop of one object. The default is the MMWand paper's."""
    min_score: Fraction = 0.3
    """Smallest confidence of a detection."""
    min_overlap: Fraction = 0.1
    """Smallest IoU of the sensor at the contact and the touched object."""
    min_deformation: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 1.5
    """Smallest deformation that counts as contact, as a multiple of the untouched frames' noise."""

    def __post_init__(self) -> None:
        """Check that a box given for the sensor is one."""
        if (box := self.sensor_box) and (box[2] - box[0] < 1 or box[3] - box[1] < 1):
            raise ValueError(f"must be left, top, right and bottom, not {box}")

    def as_json(self) -> dict[str, Any]:
        """Return these options alone, as a JSON file gives them back."""
        options = {f.name: getattr(self, f.name) for f in fields(AnnotationSettings)}
        return json.loads(json.dumps(options))

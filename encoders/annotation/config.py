"""Options of the annotation; light to import, `--help` shows them."""

import json
from dataclasses import fields
from typing import Any

from touchgoal.runtime.option_types import Fraction, checked_dataclass


@checked_dataclass
class AnnotationSettings:
    """The sensor's place and thresholds."""

    sensor_box: tuple[float, float, float, float] | None = None
    """The sensor in the first camera image of every recording: left, top, right, bottom, px. Default: the
    detector finds it as "robot gripper"."""
    min_score: Fraction = 0.3
    """Smallest confidence of a detection."""
    min_overlap: Fraction = 0.1
    """Smallest IoU of the sensor at the contact and the touched object."""

    def __post_init__(self) -> None:
        """Check that a box given for the sensor is one."""
        if (box := self.sensor_box) and (box[2] - box[0] < 1 or box[3] - box[1] < 1):
            raise ValueError(f"must be left, top, right and bottom, not {box}")

    def as_json(self) -> dict[str, Any]:
        """Return these options alone, as a JSON file gives them back."""
        options = {f.name: getattr(self, f.name) for f in fields(AnnotationSettings)}
        return json.loads(json.dumps(options))

"""A fingertip sensor: a camera whose pictures are cut and scaled to its model's image."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control.interfaces import Camera, Frame
from touchgoal.control.sensors.gel_corners import rectify
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Corners


@dataclass(frozen=True)
class Crop:
    """How a sensor's picture lies in its camera's.

    Attributes:
        border: share cut off at each of the four sides; 0 of a stream that is cut already.
        quarter_turns: counter-clockwise, before cutting; a DIGIT's camera lies on its side.
        corners: of the gel, in place of a border, of a camera that sees it at an angle (a GelSight Wedge's);
            after the turns.
    """

    border: float = 0.0
    quarter_turns: int = 0
    corners: Corners | None = None


# Of a whole GelSight Mini picture its SDK cuts a seventh off each side, the case's edge, and scales
# the rest; digit-interface turns the pictures upright.
GELSIGHT_MINI_CROP = Crop(border=1 / 7)
DIGIT_CROP = Crop(quarter_turns=1)
NO_CROP = Crop()


class TactileCamera:
    """The TactileSensor protocol over a Camera; it closes the camera with it."""

    def __init__(self, camera: Camera, model: SensorModel, crop: Crop) -> None:
        self._camera, self._model, self._crop = camera, model, crop
        self._last: tuple[Frame, Frame] | None = None

    @property
    def model(self) -> SensorModel:
        """See TactileSensor."""
        return self._model

    @property
    def rate(self) -> float:
        """See Camera."""
        return self._camera.rate

    @property
    def problem(self) -> str:
        """See Camera."""
        return self._camera.problem

    def read(self) -> Frame:
        """See Camera; UserError if the picture's proportions are not the sensor's."""
        frame = self._camera.read()
        if self._last is None or self._last[0] is not frame:
            self._last = (
                frame,
                replace(frame, image=crop_to_sensor(frame.image, self._model, self._crop)),
            )
        return self._last[1]

    def close(self) -> None:
        """See Camera."""
        self._camera.close()


def crop_to_sensor(
    image: UInt8[np.ndarray, "h w 3"], model: SensorModel, crop: Crop
) -> UInt8[np.ndarray, "H W 3"]:
    """The sensor's picture in its camera's, at the model's shape.

    Raises:
        UserError: the picture's proportions are not the sensor's, or the corners are none of a gel in it.
    """
    image = np.rot90(image, crop.quarter_turns)
    if crop.corners is not None:
        return rectify(np.ascontiguousarray(image), model.image_shape, crop.corners)
    height, width = image.shape[:2]
    top, left = int(crop.border * height), int(crop.border * width)
    image = image[top : height - top, left : width - left]
    rows, columns = model.image_shape
    ratio = image.shape[1] / image.shape[0] / (columns / rows)
    if not 0.97 < ratio < 1.03:
        raise UserError(
            f"the picture of the {model.name} is {image.shape[1]}x{image.shape[0]}, not "
            f"{columns}:{rows}: correct `border` or `quarter_turns` of its crop"
        )
    if image.shape[:2] == (rows, columns):
        return np.ascontiguousarray(image)
    return cv2.resize(np.ascontiguousarray(image), (columns, rows), interpolation=cv2.INTER_AREA)

"""Fingertip sensors as cameras: pictures cut and scaled to the sensor model's image."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control.interfaces import Camera, DriverError, Frame
from touchgoal.control.sensors.gel_corners import rectify
from touchgoal.control.tactile.picture_guard import seam
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Corners


@dataclass(frozen=True)
class Crop:
    """Position of the gel in its camera's picture.

    Attributes:
        border: share cut off at each side; 0 for a stream that is already cut.
        quarter_turns: counter-clockwise, before cutting; a DIGIT's camera lies on its side.
        corners: of the gel after the turns, px, in place of a border; for a camera that sees the
            gel at an angle (GelSight Wedge).
    """

    border: float = 0.0
    quarter_turns: int = 0
    corners: Corners | None = None


# The GelSight Mini's SDK cuts a seventh off each side, the case's edge; digit-interface turns
# upright.
GELSIGHT_MINI_CROP = Crop(border=1 / 7)
DIGIT_CROP = Crop(quarter_turns=1)
NO_CROP = Crop()


class TactileCamera:
    """The TactileSensor interface over a Camera; it closes the camera with it.

    A torn or rolled picture is left out: the frame before it stays, with its stamp.
    """

    def __init__(self, camera: Camera, model: SensorModel, crop: Crop) -> None:
        self._camera, self._model, self._crop = camera, model, crop
        self._raw: Frame | None = None
        self._whole: Frame | None = None
        self._torn = ""

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
        return self._camera.problem or self._torn

    def read(self) -> Frame:
        """See Camera; UserError if the picture's proportions are not the sensor's."""
        raw = self._camera.read()
        if self._raw is not raw:
            frame = replace(raw, image=crop_to_sensor(raw.image, self._model, self._crop))
            self._raw, self._torn = raw, seam(frame.image)
            if not self._torn:
                self._whole = frame
        if self._whole is None:
            raise DriverError(f"the picture of the {self._model.name}: {self._torn}")
        return self._whole

    def close(self) -> None:
        """See Camera."""
        self._camera.close()


def crop_to_sensor(
    image: UInt8[np.ndarray, "h w 3"], model: SensorModel, crop: Crop
) -> UInt8[np.ndarray, "H W 3"]:
    """Cut the sensor's picture out of its camera's and scale it to the model's shape.

    Raises:
        UserError: the picture has other proportions, or the corners are no quadrangle in it.
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

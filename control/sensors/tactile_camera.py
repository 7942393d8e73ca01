"""Fingertip sensors as cameras: images cut and scaled to the sensor model's image."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.arrays import Image
from touchgoal.control.interfaces import Camera, DriverError, Frame
from touchgoal.control.tactile.image_guard import find_seam
from touchgoal.control.tactile.sensor_models import DIGIT, GELSIGHT_WEDGE, SensorModel
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Corners


@dataclass(frozen=True)
class Crop:
    """Position of the gel in its camera's image."""

    border: float = 0.0  # share cut off at each side; 0 for a stream that is already cut
    quarter_turns: int = 0  # counter-clockwise, before cutting; a DIGIT's camera lies on its side
    # of the gel after the turns, px, in place of a border (GelSight Wedge)
    corners: Corners | None = None


# The GelSight Mini's SDK cuts a seventh off each side, the case's edge; digit-interface turns
# upright.
GELSIGHT_MINI_CROP = Crop(border=1 / 7)
DIGIT_CROP = Crop(quarter_turns=1)
NO_CROP = Crop()


class TactileCamera:
    """The TactileSensor interface over a Camera; it closes the camera with it.

    A torn or rolled image is left out: the frame before it stays, with its stamp.
    """

    def __init__(self, camera: Camera, model: SensorModel, crop: Crop) -> None:
        self._camera, self.model, self._crop = camera, model, crop
        self._raw: Frame | None = None
        self._whole: Frame | None = None
        self._torn = ""

    @property
    def problem(self) -> str:
        """See Camera."""
        return self._camera.problem or self._torn

    def read(self) -> Frame:
        """See Camera; UserError if the image's proportions are not the sensor's."""
        raw = self._camera.read()
        if self._raw is not raw:
            frame = replace(raw, image=crop_to_sensor(raw.image, self.model, self._crop))
            before = self._whole.image if self._whole else None
            self._raw, self._torn = raw, find_seam(frame.image, before)
            if not self._torn:
                self._whole = frame
        if self._whole is None:
            raise DriverError(f"the image of the {self.model.name}: {self._torn}")
        return self._whole

    def close(self) -> None:
        """See Camera."""
        self._camera.close()


def fingertip_view(
    model: SensorModel, source: str, border: float | None = None, corners: Corners | None = None
) -> Crop:
    """Return the crop of a source; a stream without corners is already cut and turned.

    UserError if the camera sees the gel at an angle and the corners are missing.
    """
    if corners is not None:
        return Crop(corners=corners)
    if model.name == GELSIGHT_WEDGE.name and "://" not in source:
        raise UserError(
            f"the camera of a {model.name} sees its gel at an angle: give the corners of the gel "
            "in its image"
        )
    view = DIGIT_CROP if model.name == DIGIT.name else GELSIGHT_MINI_CROP
    view = NO_CROP if "://" in source else view
    return view if border is None else replace(view, border=border)


def crop_to_sensor(image: Image, model: SensorModel, crop: Crop) -> UInt8[np.ndarray, "H W 3"]:
    """Cut the sensor's image out of its camera's and scale it to the model's shape.

    UserError if it has other proportions, or the corners are no quadrangle in it.
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
            f"the image of the {model.name} is {image.shape[1]}x{image.shape[0]}, not "
            f"{columns}:{rows}: correct `border` or `quarter_turns` of its crop"
        )
    if image.shape[:2] == (rows, columns):
        return np.ascontiguousarray(image)
    return cv2.resize(np.ascontiguousarray(image), (columns, rows), interpolation=cv2.INTER_AREA)


def rectify(image: Image, shape: tuple[int, int], corners: Corners) -> UInt8[np.ndarray, "H W 3"]:
    """Return the gel between its corners from above, in an image of a shape (rows, columns).

    UserError if the corners are no quadrangle in the image.
    """
    given = np.array(corners, np.float32)
    _check_corners(given, image.shape[:2])
    rows, columns = shape
    # First at the camera's resolution, then reduced, so that pixels are averaged, not skipped.
    finer = max(1, round(float(np.linalg.norm(given[1] - given[0])) / columns))
    high, wide = finer * rows, finer * columns
    # The corners of an image lie half a pixel out from the middles of its outermost pixels.
    edges = np.array([(0, 0), (wide, 0), (0, high), (wide, high)], np.float32) - 0.5
    flat = cv2.warpPerspective(image, cv2.getPerspectiveTransform(given, edges), (wide, high))
    return cv2.resize(flat, (columns, rows), interpolation=cv2.INTER_AREA) if finer > 1 else flat


def _check_corners(corners: Float32[np.ndarray, "4 2"], shape: tuple[int, int]) -> None:
    """Raise UserError unless these are corners of a gel in an image of a shape (rows, columns)."""
    height, width = shape
    if (corners < -0.5).any() or (corners > np.array([width, height]) - 0.5).any():
        raise UserError(
            f"a corner of the gel lies outside its camera's image, which is {width}x{height}: "
            "give them in pixels of that image, top left, top right, bottom left, bottom right"
        )
    around = corners[[0, 1, 3, 2]]
    sides = np.roll(around, -1, 0) - around
    following = np.roll(sides, -1, 0)
    if (sides[:, 0] * following[:, 1] <= sides[:, 1] * following[:, 0]).any():
        raise UserError(
            "the corners of the gel must be top left, top right, bottom left and bottom right in "
            "the image; these are in another order, or no quadrangle"
        )

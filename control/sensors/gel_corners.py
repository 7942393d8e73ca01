"""Rectification of a gel seen at an angle (GelSight Wedge), from its four corners."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Corners


def rectify(
    image: UInt8[np.ndarray, "h w 3"], shape: tuple[int, int], corners: Corners
) -> UInt8[np.ndarray, "H W 3"]:
    """Return the gel between its corners from above, in a picture of a shape (rows, columns).

    Raises:
        UserError: the corners are no quadrangle in the picture.
    """
    given = np.array(corners, np.float32)
    _check_corners(given, image.shape[:2])
    rows, columns = shape
    # Larger than asked for where the camera shows more, so that its pixels are averaged, not left
    # out.
    finer = max(1, round(float(np.linalg.norm(given[1] - given[0])) / columns))
    high, wide = finer * rows, finer * columns
    # The corners of a picture lie half a pixel out from the middles of its outermost pixels.
    edges = np.array([(0, 0), (wide, 0), (0, high), (wide, high)], np.float32) - 0.5
    flat = cv2.warpPerspective(image, cv2.getPerspectiveTransform(given, edges), (wide, high))
    return cv2.resize(flat, (columns, rows), interpolation=cv2.INTER_AREA) if finer > 1 else flat


def _check_corners(corners: Float32[np.ndarray, "4 2"], shape: tuple[int, int]) -> None:
    """Raise UserError unless these are corners of a gel in a picture of a shape (rows, columns)."""
    height, width = shape
    if (corners < -0.5).any() or (corners > np.array([width, height]) - 0.5).any():
        raise UserError(
            f"a corner of the gel lies outside its camera's picture, which is {width}x{height}: "
            "give "
            "them in pixels of that picture, top left, top right, bottom left, bottom right"
        )
    around = corners[[0, 1, 3, 2]]
    sides = np.roll(around, -1, 0) - around
    following = np.roll(sides, -1, 0)
    if (sides[:, 0] * following[:, 1] <= sides[:, 1] * following[:, 0]).any():
        raise UserError(
            "the corners of the gel must be top left, top right, bottom left and bottom right in "
            "the "
            "picture; these are in another order, or no quadrangle"
        )

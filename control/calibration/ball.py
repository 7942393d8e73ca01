"""A ball pressed into a gel: the contact circle in a picture, and the surface under the ball."""

import math

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from touchgoal.control.tactile import gel
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.control.tactile.sensor_calibration import SensorCalibration
from touchgoal.runtime.errors import UserError

Circle = Float[np.ndarray, " 3"]
"""Centre x (column), centre y (row) and radius of a contact, px; (0, 0) is the first pixel."""

_FIND_BLUR = 2.0  # px
_DISC_SHARE = 0.3  # of the strongest change, at which the disc is taken to end
_MIN_CHANGE = 8.0  # counts
# The gel bulges around the contact: the visible disc is larger. On 46 real presses of two balls the
# fitted contacts are 0.7 of it.
_CONTACT_PER_DISC = 0.7


def ball_overlap(
    shape: tuple[int, int], pitch: float, circle: Circle, ball_radius: float
) -> Float32[np.ndarray, "h w"]:
    """Return the overlap (m) of ball and flat gel with which the deformed gel touches in a circle.

    The gel touches where the overlap exceeds `gel.CONTACT_SHARE` of its maximum, so the ball's cap
    over the circle has the remaining share of its depth.

    Args:
        shape: rows and columns of the picture.
        pitch: m per pixel.
        circle: of the contact.
        ball_radius: m; must exceed the contact's.
    """
    x, y, radius = circle
    rows, cols = np.ogrid[: shape[0], : shape[1]]
    square = ((cols - x) ** 2 + (rows - y) ** 2) * pitch**2
    cap = ball_radius - math.sqrt(ball_radius**2 - (radius * pitch) ** 2)
    height = np.sqrt(np.maximum(ball_radius**2 - square, 0)) - ball_radius
    overlap = np.maximum(height + cap / (1 - gel.CONTACT_SHARE), 0)
    return np.where(square < ball_radius**2, overlap, 0).astype(np.float32)


def press_surface(
    calibration: SensorCalibration, circle: Circle, ball_radius: float
) -> Float32[np.ndarray, "h w"]:
    """Return the gel's surface (m) under a ball, with the sensor file's bulge."""
    rows, cols, _ = calibration.background.shape
    raw = ball_overlap((rows, cols), calibration.pixel_pitch, circle, ball_radius)
    return gel.deform(raw, calibration.pixel_pitch, calibration.blur_sigmas)


def find_circle(
    image: UInt8[np.ndarray, "h w 3"], background: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "3"]:
    """Find the contact of one ball: centre x, centre y and radius, px, to be moved by the fit.

    Args:
        image: RGB picture of the press.
        background: the sensor untouched.

    Raises:
        UserError: no change stands out.
    """
    change = remove_gain(image, background) - background
    change -= np.median(change, (0, 1))
    strength = np.sqrt((cv2.GaussianBlur(change, (0, 0), _FIND_BLUR) ** 2).sum(2))
    strongest = float(np.percentile(strength, 99.7))
    if strongest < _MIN_CHANGE:
        raise UserError(
            f"no contact is visible ({strongest:.0f} counts of change): drop the picture, press "
            "harder, or record background.png again"
        )
    disc = (strength > _DISC_SHARE * strongest).astype(np.uint8)
    disc = cv2.morphologyEx(disc, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))
    outlines, _ = cv2.findContours(disc, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        raise UserError("what changes is no disc: drop the picture, or give its circle")
    (x, y), radius = cv2.minEnclosingCircle(max(outlines, key=cv2.contourArea))
    return np.array([x, y, _CONTACT_PER_DISC * radius])

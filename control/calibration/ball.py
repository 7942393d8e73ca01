"""A ball pressed into a gel: contact circle in an image, surface below, sphere in a depth map."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from touchgoal.control.arrays import Circle, Image, Map
from touchgoal.control.tactile import gel
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.control.tactile.sensor_calibration import SensorCalibration
from touchgoal.runtime.errors import UserError

_FIND_BLUR = 2.0  # px
_DISC_SHARE = 0.3  # share of the strongest change at the disc's outline
_MIN_CHANGE = 8.0  # counts
# The gel bulges around the contact: the visible disc is larger. On 46 real presses of two balls the
# fitted contacts are 0.7 of it.
_CONTACT_PER_DISC = 0.7
_INSIDE = 0.9  # share of the contact's radius within which the gel follows the ball
_OUTLIER = 20e-6  # m


def squared_distance(shape: tuple[int, ...], circle: Circle) -> Float[np.ndarray, "h w"]:
    """Return the squared distance of each pixel of an image from the circle's centre, px^2."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return (columns - circle[0]) ** 2 + (rows - circle[1]) ** 2


def ball_overlap(shape: tuple[int, int], pitch: float, circle: Circle, ball_radius: float) -> Map:
    """Return the overlap (m) of ball and flat gel that makes the deformed gel touch in `circle`.

    The gel touches where the overlap exceeds `gel.CONTACT_SHARE` of its maximum, so the ball's cap
    over the circle is `1 - CONTACT_SHARE` of the deepest overlap. `pitch` is m per pixel; the
    ball's radius (m) must exceed the contact's.
    """
    square = squared_distance(shape, circle) * pitch**2
    cap = ball_radius - math.sqrt(ball_radius**2 - (circle[2] * pitch) ** 2)
    height = np.sqrt(np.maximum(ball_radius**2 - square, 0)) - ball_radius
    overlap = np.maximum(height + cap / (1 - gel.CONTACT_SHARE), 0)
    return np.where(square < ball_radius**2, overlap, 0).astype(np.float32)


def press_surface(calibration: SensorCalibration, circle: Circle, ball_radius: float) -> Map:
    """Return the gel's surface (m) under a ball, with the sensor file's bulge."""
    rows, cols, _ = calibration.background.shape
    raw = ball_overlap((rows, cols), calibration.pixel_pitch, circle, ball_radius)
    return gel.deform(raw, calibration.pixel_pitch, calibration.blur_sigmas)


def find_circle(image: Image, background: Image) -> Circle:
    """Find a ball's contact in RGB, to be moved by the fit: centre x, y and radius, px.

    UserError if no change from the untouched sensor stands out.
    """
    change = remove_gain(image, background) - background
    change -= np.median(change, (0, 1))
    strength = np.sqrt((cv2.GaussianBlur(change, (0, 0), _FIND_BLUR) ** 2).sum(2))
    strongest = float(np.percentile(strength, 99.7))
    if strongest < _MIN_CHANGE:
        raise UserError(
            f"no contact is visible ({strongest:.0f} counts of change): drop the image, press "
            "harder, or record background.png again"
        )
    disc = (strength > _DISC_SHARE * strongest).astype(np.uint8)
    disc = cv2.morphologyEx(disc, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))
    outlines, _ = cv2.findContours(disc, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        raise UserError("the change is not a disc: drop the image, or give its circle")
    (x, y), radius = cv2.minEnclosingCircle(max(outlines, key=cv2.contourArea))
    return np.array([x, y, _CONTACT_PER_DISC * radius])


@dataclass(frozen=True)
class DepthErrors:
    """Errors of the depth read from one press."""

    radius: float  # radius of the sphere in the depth map over the ball's
    residual: float  # root mean square distance of the depth map from that sphere, m
    peak_offset: float  # distance of its deepest point from the contact's centre, m


def sphere_in(depth: Map, pitch: float, circle: Circle, ball_radius: float) -> DepthErrors:
    """Fit a sphere to a depth map (m) within a contact (px), under a ball of that radius (m).

    `pitch` is m per px.
    """
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]]
    x, y, radius = circle
    inside = squared_distance(depth.shape, circle) < (_INSIDE * radius) ** 2
    px, py, z = columns[inside] * pitch, rows[inside] * pitch, depth[inside].astype(np.float64)

    def residual(at: Float[np.ndarray, "4"]) -> Float[np.ndarray, " n"]:
        cx, cy, size, top = at
        square = np.maximum(size**2 - (px - cx) ** 2 - (py - cy) ** 2, 1e-9)
        return z - (top + np.sqrt(square) - size)

    start = [x * pitch, y * pitch, ball_radius, float(z.max())]
    found = least_squares(
        residual, start, x_scale=[1e-4, 1e-4, 1e-3, 1e-4], loss="soft_l1", f_scale=_OUTLIER
    ).x
    return DepthErrors(
        radius=float(found[2] / ball_radius),
        residual=float(np.sqrt(np.mean(residual(found) ** 2))),
        peak_offset=float(np.hypot(found[0] - x * pitch, found[1] - y * pitch)),
    )

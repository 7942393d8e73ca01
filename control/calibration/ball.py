"""The surface of a gel under a ball, from the circle in which they touch."""

import math

import numpy as np
from jaxtyping import Float, Float32

from touchgoal.control.tactile import gel
from touchgoal.control.tactile.sensor_calibration import SensorCalibration

Circle = Float[np.ndarray, " 3"]
"""Centre x (column), centre y (row) and radius of a contact, px; (0, 0) is the first pixel."""


def ball_overlap(
    shape: tuple[int, int], pitch: float, circle: Circle, ball_radius: float
) -> Float32[np.ndarray, "h w"]:
    """Overlap (m) of a ball with the flat gel such that it touches the deformed gel in a circle.

    The gel touches what overlaps by more than `gel.CONTACT_SHARE` of the deepest overlap, so the
    ball's cap over the circle has the remaining share of its depth.

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
    """Surface of the gel (m) under a ball; the sensor file gives the gel's bulge."""
    rows, cols, _ = calibration.background.shape
    raw = ball_overlap((rows, cols), calibration.pixel_pitch, circle, ball_radius)
    return gel.deform(raw, calibration.pixel_pitch, calibration.blur_sigmas)

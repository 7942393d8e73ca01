"""Depth of held-out presses: the sphere in the depth map against the ball."""

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.optimize import least_squares

from touchgoal.control.calibration.ball import Circle
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.sensor_calibration import SensorCalibration

_INSIDE = 0.9  # of the contact's radius, in which the gel follows the ball
_OUTLIER = 20e-6  # m


@dataclass(frozen=True)
class DepthErrors:
    """Errors of one press, or the median over several.

    Attributes:
        radius: of the sphere in the depth map, over the ball's.
        residual: root mean square distance of the depth map from that sphere, m.
        peak_offset: of its deepest point from the contact's centre, m.
    """

    radius: float
    residual: float
    peak_offset: float


def sphere_in(
    depth: Float32[np.ndarray, "h w"], pitch: float, circle: Circle, ball_radius: float
) -> DepthErrors:
    """Fit a sphere to a depth map within a contact.

    Args:
        depth: of the gel, m.
        pitch: m per px.
        circle: of the contact, px.
        ball_radius: of the ball, m.
    """
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]]
    x, y, radius = circle
    inside = (columns - x) ** 2 + (rows - y) ** 2 < (_INSIDE * radius) ** 2
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


def depth_errors(
    calibration: SensorCalibration,
    presses: PressSet,
    circles: Float[np.ndarray, "n 3"],
    balls: Float[np.ndarray, " n"],
    finest: int = 2,
) -> list[DepthErrors]:
    """Return the errors of every press, with depth from `DepthEstimator`.

    Args:
        calibration: the sensor file.
        presses: their pictures.
        circles: of the contacts, px.
        balls: radius of each ball, m.
        finest: of the estimator, px.
    """
    estimator = DepthEstimator(calibration, finest)
    background = calibration.background.astype(np.float32)
    pitch = calibration.pixel_pitch
    return [
        sphere_in(estimator.estimate(image, background), pitch, circle, ball)
        for image, circle, ball in zip(presses.images, circles, balls, strict=True)
    ]


def median_by_ball(
    errors: list[DepthErrors], balls: Float[np.ndarray, " n"]
) -> dict[str, dict[str, float]]:
    """Return medians over the presses of each ball, by its radius in mm."""
    sizes = np.round(balls * 1e3, 3)
    table = {}
    for size in np.unique(sizes):
        own = [list(asdict(e).values()) for e, s in zip(errors, sizes, strict=True) if s == size]
        radius, residual, offset = np.median(own, 0)
        table[f"{size:g}"] = {
            "presses": len(own),
            "radius_mm": float(radius * size),
            "residual_um": float(residual * 1e6),
            "peak_offset_mm": float(offset * 1e3),
        }
    return table

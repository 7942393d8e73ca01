"""Indentation depth of a gel, fast enough for a control loop."""

from functools import cache

import numpy as np

from touchgoal.control.arrays import Image
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.gel import deform
from touchgoal.control.tactile.sensor_calibration import load, shade
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError

# Cells of half a millimetre on a Mini. On simulated grasps at 10 and 30 N the deepest point came
# out within a tenth for blocks and balls; a pebble's edges, steeper than any calibration press, at
# 60 %. Printed dots are left in: they change it by less than a tenth.
_CELL = 8  # px
_BALL = 4e-3  # m, radius of the ball that a ceiling is tried with
_READABLE = 0.8  # share of a depth that must be read


class IndentationMeter:
    """Meter of one fingertip's indentation; `untouched` is an RGB frame before any contact."""

    def __init__(self, sensor: SensorModel, untouched: Image) -> None:
        self._detector = ContactDetector(Background(untouched[None]))
        self._depth = DepthEstimator(load(sensor.sensor_file), _CELL)
        self._depth.estimate(untouched)  # compiled code is loaded now, not in a control loop

    def measure(self, frame: Image) -> float:
        """Return the deepest point of the next frame, m; 0 without contact."""
        if not self._detector.update(frame):
            return 0.0
        return float(self._depth.estimate(frame, self._detector.background.steady).max())


def deepest_readable(sensor: SensorModel, wanted: float) -> float:
    """Return the largest depth up to `wanted` that the sensor file can read, m, in steps of 0.1 mm.

    A ball is drawn by the sensor file's model and read back. With walls steeper than the
    calibration presses a deep one reads too shallow, and a ceiling above that would never be
    reached.
    """
    depth = wanted
    while depth > 0 and _read_ball(sensor, depth) < _READABLE * depth:
        depth = round(np.ceil(depth / 1e-4 - 1.001)) * 1e-4
    return depth


def require_readable(sensor: SensorModel, ceiling: float) -> None:
    """Raise UserError unless the sensor file can read a ball pressed in by `ceiling` (m)."""
    deepest = deepest_readable(sensor, ceiling)
    if deepest < ceiling:
        raise UserError(
            f"safety.indentation is {1e3 * ceiling:g} mm, deeper than the sensor file of the "
            f"{sensor.name} can read ({1e3 * deepest:.1f} mm): lower it, or calibrate with deeper "
            "presses"
        )


@cache
def _read_ball(sensor: SensorModel, depth: float) -> float:
    """Return the depth (m) read from a ball pressed into the middle of the gel by `depth` (m)."""
    calibration = load(sensor.sensor_file)
    rows, columns = calibration.background.shape[:2]
    y, x = np.mgrid[:rows, :columns].astype(np.float32)
    away = calibration.pixel_pitch * np.hypot(x - columns / 2, y - rows / 2)
    ball = np.sqrt(np.maximum(_BALL**2 - away**2, 0)) - (_BALL - np.float32(depth))
    surface = deform(
        np.maximum(ball, 0).astype(np.float32), calibration.pixel_pitch, calibration.blur_sigmas
    )
    image = np.clip(np.rint(shade(calibration, surface)), 0, 255).astype(np.uint8)
    return float(DepthEstimator(calibration, _CELL).estimate(image).max())

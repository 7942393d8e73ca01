"""How deep a gel is pressed in, fast enough for every tick of a control loop."""

import numpy as np
from jaxtyping import UInt8

from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import SensorModel

# Cells of half a millimetre on a Mini. On simulated grasps at 10 and 30 N the deepest point came out
# within a tenth for blocks and balls; a pebble's edges, steeper than any calibration press, at 60 %.
# Printed dots are left in: they change it by less than a tenth.
_CELL = 8  # px


class IndentationMeter:
    """Follows one fingertip sensor from its untouched picture on.

    Args:
        sensor: its model.
        untouched: RGB frame of the untouched gel.
    """

    def __init__(self, sensor: SensorModel, untouched: UInt8[np.ndarray, "h w 3"]) -> None:
        self._detector = ContactDetector(Background(untouched[None]))
        self._depth = DepthEstimator(load(sensor.sensor_file), _CELL)

    def measure(self, frame: UInt8[np.ndarray, "h w 3"]) -> float:
        """The deepest point in the next frame, m; 0 while nothing touches."""
        if not self._detector.update(frame):
            return 0.0
        return float(self._depth.estimate(frame, self._detector.background.image).max())

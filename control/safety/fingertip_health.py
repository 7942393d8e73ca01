"""Health of a fingertip from its images: light, noise, and that they change."""

import cv2
import numpy as np

from touchgoal.control.arrays import Image
from touchgoal.control.sensors.image_integrity import FrozenParts
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import SensorModel

_DARK = 0.3  # share of the sensor file's brightness below which the light is out
_BRIGHT = 245.0  # counts: mean above which the picture is overexposed
# Counts: mean second difference along the rows of the middle cell; noise of 1 count makes 2. Real
# Minis, DIGITs and Wedges reach 1 to 4.3, simulated ones 2 to 5.
_NOISY = 12.0
_SECOND_DIFFERENCE = np.array([[1.0, -2.0, 1.0]], np.float32)
_CELL = 8  # px
_CONFIRMING = 3  # new frames in a row; a driver may pass on a single bad one
_STILL = 6  # new frames in a row without a change, 0.3 s of a control loop


class FingertipHealth:
    """Health of one fingertip, followed frame by frame."""

    def __init__(self, sensor: SensorModel) -> None:
        self._parts = FrozenParts()
        self._usual = float(load(sensor.sensor_file).background.mean())  # counts, untouched
        self._frames = self._bad = 0

    @property
    def doubtful(self) -> bool:
        """Whether the newest frame shows a fault, so that nothing is to be read from it."""
        return self._bad > 0

    def update(self, frame: Image) -> str:
        """Take the next new RGB frame; return what is wrong with the fingertip, "" if nothing."""
        self._frames += 1
        if self._frames - self._parts.update(frame, self._frames) >= _STILL:
            return "its image or a part of it stands still: check its cable and driver"
        wrong = self.fault(frame)
        self._bad = self._bad + 1 if wrong else 0
        return wrong if self._bad >= _CONFIRMING else ""

    def fault(self, frame: Image) -> str:
        """Return what is wrong with one RGB image, touched or not; "" if nothing."""
        light = sum(cv2.sumElems(frame)) / frame.size
        if light < _DARK * self._usual:
            return "its image is black: check its light and cable"
        if light > _BRIGHT:
            return "its image is overexposed: check its exposure"
        if (noise := _noise(frame)) > _NOISY:
            return (
                f"its image is noise ({noise:.0f} counts, a sensor's is below 5): check its cable"
            )
        return ""


def _noise(frame: Image) -> float:
    """Return the mean second difference of the middle cell (counts): dots and edges are few."""
    rough = np.abs(cv2.filter2D(frame, cv2.CV_16S, _SECOND_DIFFERENCE)[:, 1:-1])
    size = max(rough.shape[1] // _CELL, 1), max(rough.shape[0] // _CELL, 1)
    cells = cv2.resize(rough.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return float(np.median(cells.mean(2)))

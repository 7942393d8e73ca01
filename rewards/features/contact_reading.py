"""Contact of each fingertip frame by frame: whether it touches, how hard, where, and slip."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from touchgoal.control.arrays import Picture
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector, threshold_for
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.force import contact_centre, estimate_force
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.features.slip import SlipMeter

_CELL = 8  # px, finest cells of the depth map: a third of the time of 2 (`DepthEstimator`)


@dataclass(frozen=True, eq=False)
class ContactReadings:
    """Contact of the fingertips at each frame; 0 where nothing touches."""

    touching: Bool[np.ndarray, "sides n"]
    # None where the sensor has no calibration file
    force: Float32[np.ndarray, "sides n"] | None = None  # normal force, N
    centre: Float32[np.ndarray, "sides n 2"] | None = None  # m from the image's middle, x and y
    slip: Float32[np.ndarray, "sides n"] | None = None  # m, see `SlipMeter`

    def take(self, rows: slice | np.ndarray) -> "ContactReadings":
        """Return the readings of some frames."""
        return self._map(lambda reading: reading[:, rows])

    def of_sides(self, sides: np.ndarray) -> "ContactReadings":
        """Return the readings of some fingertips, in this order."""
        return self._map(lambda reading: reading[sides])

    @staticmethod
    def join(pieces: "Sequence[ContactReadings]") -> "ContactReadings":
        """Return consecutive readings of the same fingertips as one."""
        return _concatenated(pieces, axis=1)

    @staticmethod
    def stack(sides: "Sequence[ContactReadings]") -> "ContactReadings":
        """Return the readings of several fingertips as one."""
        return _concatenated(sides, axis=0)

    def _map(self, change: Callable[[np.ndarray], np.ndarray]) -> "ContactReadings":
        known = {
            name: change(reading) for name, reading in vars(self).items() if reading is not None
        }
        return ContactReadings(**known)


def _concatenated(readings: Sequence[ContactReadings], axis: int) -> ContactReadings:
    known = [name for name, reading in vars(readings[0]).items() if reading is not None]
    return ContactReadings(
        **{name: np.concatenate([vars(r)[name] for r in readings], axis=axis) for name in known}
    )


class ContactReader:
    """Reader of one fingertip, frame after frame: contact begins and ends with hysteresis.

    Depth, and so force and centre, count from the untouched gel, which is followed as it drifts.
    Printed dots are left in. The force is nominal: `estimate_force`.
    """

    def __init__(
        self, sensor: SensorModel | None, untouched: UInt8[np.ndarray, "n h w 3"], fps: float
    ) -> None:
        """Take the sensor model, None for an unknown sensor, frames without contact, and the rate."""
        self._sensor, self._slip = sensor, SlipMeter(fps)
        self._depth: DepthEstimator | None = None
        self._pitch, self._size = 0.0, untouched.shape[2:0:-1]
        if sensor is not None:
            calibration = load(sensor.sensor_file)
            self._depth = DepthEstimator(calibration, _CELL)
            self._pitch = calibration.pixel_pitch
            self._size = calibration.background.shape[1::-1]
        untouched = np.stack([self._resized(frame) for frame in untouched])
        background = touch_background(untouched)
        threshold = threshold_for(untouched, background)
        self._detector = ContactDetector(Background(background[None]), threshold)

    def read(self, frames: UInt8[np.ndarray, "n h w 3"]) -> ContactReadings:
        """Return the readings of the next frames, as one side."""
        touching, force, centre, slip = [], [], [], []
        for frame in frames:
            now, f, c = self._read_frame(self._resized(frame))
            touching.append(now)
            force.append(f)
            centre.append(c)
            slip.append(self._slip.update(now, c))
        if self._sensor is None:
            return ContactReadings(np.array([touching]))
        return ContactReadings(
            np.array([touching]),
            np.array([force], np.float32),
            np.array([centre], np.float32),
            np.array([slip], np.float32),
        )

    def _read_frame(self, frame: Picture) -> tuple[bool, float, tuple[float, float]]:
        touching = self._detector.update(frame)
        if self._depth is None or self._sensor is None or not touching:
            return touching, 0.0, (0.0, 0.0)
        depth = self._depth.estimate(frame, self._detector.background.steady)
        force = estimate_force(depth, self._pitch, self._sensor)
        return touching, force, contact_centre(depth, self._pitch)

    def _resized(self, frame: Picture) -> Picture:
        if frame.shape[1::-1] == self._size:
            return frame
        return cv2.resize(frame, self._size, interpolation=cv2.INTER_AREA)

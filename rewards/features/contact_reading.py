"""Contact of each fingertip frame by frame: whether it touches, how hard, where, and slip."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.force import contact_centre, estimate_force
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.episodes.touches import contact_detector

_CELL = 8  # px, finest cells of the depth map: a third of the time of 2 (`DepthEstimator`)
_SETTLES = 0.4  # s of contact in which a grasp settles; validation: AUC of slips .93, without .91
_LOST = 0.4  # s without contact after which the grasp is over


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
        self._pitch, size = 0.0, untouched.shape[2:0:-1]
        if sensor is not None:
            calibration = load(sensor.sensor_file)
            if not sensor.images_only:
                self._depth = DepthEstimator(calibration, _CELL)
            self._pitch = calibration.pixel_pitch
            size = calibration.background.shape[1::-1]
        self._size = size
        self._detector = contact_detector(np.stack([self._resized(f) for f in untouched]))

    def _resized(self, frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "y x 3"]:
        return np.asarray(cv2.resize(frame, self._size, interpolation=cv2.INTER_AREA))

    def read(self, frames: UInt8[np.ndarray, "n h w 3"]) -> dict[str, np.ndarray]:
        """Return by part (`features.embedded`) the readings of the next frames, (n,) or (n, 2).

        Of a sensor without a calibration file, or a computed one, whether it touches alone.
        """
        held, force, centre, slip = [], [], [], []
        for frame in map(self._resized, frames):
            held.append(self._detector.update(frame))
            if self._depth is None or self._sensor is None:
                continue
            newtons, middle = 0.0, (0.0, 0.0)
            if held[-1]:
                depth = self._depth.estimate(frame, self._detector.background.steady)
                newtons = estimate_force(depth, self._pitch, self._sensor)
                middle = contact_centre(depth, self._pitch)
            force.append(newtons)
            centre.append(middle)
            slip.append(self._slip.update(held[-1], middle))
        numbers = {"force": force, "centre": centre, "slip": slip} if self._depth else {}
        readings = {name: np.array(values, np.float32) for name, values in numbers.items()}
        return {"held": np.array(held)} | readings


class SlipMeter:
    """Slip on one fingertip: how far the contact's centre has moved on the gel since the grasp.

    It is measured frame after frame; a short loss of contact does not end the grasp.
    """

    def __init__(self, fps: float) -> None:
        """`fps`: frames per second."""
        self._fps = fps
        self._grasp: Float[np.ndarray, " 2"] | None = None  # centre where the grasp settled
        self._held = self._free = 0  # frames in contact since the grasp; without contact
        self._slip = 0.0

    def update(self, touching: bool, centre: tuple[float, float]) -> float:
        """Return the distance (m) of the contact's centre from where the grasp settled.

        During a short loss of contact it stays as it was; without a grasp it is 0.
        """
        if not touching:
            self._free += 1
            if self._free / self._fps > _LOST:
                self._grasp, self._held, self._slip = None, 0, 0.0
            return self._slip
        now = np.array(centre)
        if self._grasp is None or self._held / self._fps < _SETTLES:
            self._grasp = now
        self._held, self._free = self._held + 1, 0
        self._slip = float(np.linalg.norm(now - self._grasp))
        return self._slip

"""Grasp force from pictures alone, calibrated from a few grasps with a load cell.

No gel model, no sensor file: how strongly and how widely a picture differs from the untouched sensor,
beyond any drift of the light, read by a ridge regression. For a sensor whose geometry is not known
(`force.estimate_force` needs it), and for one whose stiffness is not.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from touchgoal.control.tactile.background import local_change
from touchgoal.runtime.errors import UserError

STRENGTH = 10.0
"""Of the ridge; from 0.1 to 100 the error on real grasps of other things stays below 2.2 N."""
_WIDTH = 320  # px; pictures are brought to it
_PERCENTILES = (50, 75, 90, 97, 99.5)
_COUNTS = (3, 6, 12, 24)  # of change, whose area counts
_LEAST_FRAMES = 50


@dataclass(frozen=True, eq=False)
class PictureForce:
    """A calibrated reader.

    Attributes:
        mean, spread: of the statistics in the calibration.
        weights: N per spread of each.
        offset: N.
    """

    mean: Float[np.ndarray, " k"]
    spread: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, " k"]
    offset: float

    def read(
        self, frame: UInt8[np.ndarray, "h w 3"], background: Float32[np.ndarray, "h2 w2 3"]
    ) -> float:
        """Force, N, not below 0.

        Args:
            frame: RGB.
            background: the sensor untouched as it is now, `shrunk`.
        """
        return float(self.of_statistics(statistics(frame, background)[None])[0])

    def of_statistics(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """Force, N, of rows of `statistics`."""
        force = (rows - self.mean) / self.spread @ self.weights + self.offset
        return np.maximum(force, 0)


def calibrate_force(rows: Float[np.ndarray, "n k"], force: Float[np.ndarray, " n"]) -> PictureForce:
    """Fit to grasps of things like those to come: balls tell little about blocks.

    Args:
        rows: `statistics` of each frame, untouched ones among them.
        force: measured, N.

    Raises:
        UserError: too few frames, or no force among them.
    """
    if len(rows) < _LEAST_FRAMES or np.ptp(force) < 1:
        raise UserError(
            f"{len(rows)} frames with forces of up to {np.ptp(force):.1f} N are too few: record some grasps "
            f"of several things, {_LEAST_FRAMES} frames or more, from open to firm"
        )
    mean, spread = rows.mean(0), rows.std(0) + 1e-6
    known, offset = (rows - mean) / spread, float(force.mean())
    square = known.T @ known + STRENGTH * np.eye(known.shape[1])
    return PictureForce(mean, spread, np.linalg.solve(square, known.T @ (force - offset)), offset)


def shrunk(picture: np.ndarray) -> Float32[np.ndarray, "h w 3"]:
    """A picture 320 pixels wide, float."""
    h, w, _ = picture.shape
    size = _WIDTH, round(h * _WIDTH / w)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def statistics(
    frame: UInt8[np.ndarray, "h w 3"], background: Float32[np.ndarray, "h2 w2 3"]
) -> Float[np.ndarray, " k"]:
    """Strength and extent of what changed: each as it is, its root and its logarithm."""
    small = shrunk(frame)
    local, change = local_change(small, background), small - background
    plain = np.array(
        [
            local.mean(),
            *np.percentile(local, _PERCENTILES),
            *((local > counts).mean() for counts in _COUNTS),
            np.abs(change).mean(),
            *np.abs(change.mean((0, 1))),
        ],
        np.float64,
    )
    return np.concatenate([plain, np.sqrt(plain), np.log(plain + 0.05)])

"""Contact force on a fingertip from the change of its image, without gel model or sensor file."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from touchgoal.control.arrays import Counts, Image
from touchgoal.control.tactile.background import local_change
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.runtime.errors import UserError

RIDGE_STRENGTH = 10.0
"""From 0.1 to 100 the error on real grasps of unseen objects stays below 2.2 N."""
_WIDTH = 320  # px
_PERCENTILES = (50, 75, 90, 97, 99.5)
_COUNTS = (3, 6, 12, 24)  # counts of change; the areas above them are statistics
_MIN_FRAMES = 50


@dataclass(frozen=True, eq=False)
class ImageForce:
    """Ridge regression from `change_statistics` to force (N), without gel model or sensor file.

    `mean` and `spread` are of the statistics in the calibration grasps; `weights` are N per spread.
    """

    mean: Float[np.ndarray, " k"]
    spread: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, " k"]
    offset: float

    def predict(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """Return the force of each row of statistics, N, not below 0."""
        return np.maximum((rows - self.mean) / self.spread @ self.weights + self.offset, 0)


def calibrate_force(rows: Float[np.ndarray, "n k"], force: Float[np.ndarray, " n"]) -> ImageForce:
    """Fit forces (N) to `change_statistics` of grasps on a load cell, untouched frames included.

    The objects should be similar to those to come. UserError if there are too few frames, or no
    force.
    """
    if len(rows) < _MIN_FRAMES or np.ptp(force) < 1:
        raise UserError(
            f"{len(rows)} frames with forces of up to {np.ptp(force):.1f} N are too few: record "
            f"grasps of several objects, {_MIN_FRAMES} frames or more, from open to firm"
        )
    mean, spread = rows.mean(0), rows.std(0) + 1e-6
    known, offset = (rows - mean) / spread, float(force.mean())
    square = known.T @ known + RIDGE_STRENGTH * np.eye(known.shape[1])
    return ImageForce(mean, spread, np.linalg.solve(square, known.T @ (force - offset)), offset)


def resized(image: np.ndarray) -> Counts:
    """Return an image scaled to 320 pixels of width."""
    h, w, _ = image.shape
    size = _WIDTH, round(h * _WIDTH / w)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def change_statistics(
    frame: Image, background: Float32[np.ndarray, "h2 w2 3"]
) -> Float[np.ndarray, " k"]:
    """Return strength and extent of the change from the untouched image (`resized`).

    Each statistic appears as it is, as its root and as its logarithm.
    """
    small = remove_gain(resized(frame), background)
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

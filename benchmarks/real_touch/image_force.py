"""Contact force on a fingertip from the change of its image and the shape of the contact."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from touchgoal.control.arrays import Counts, Image, Map
from touchgoal.control.tactile.background import local_change
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.runtime.errors import UserError

RIDGE_STRENGTH = 30.0
"""From 10 to 100 the median error on real grasps of unseen objects stays below 1.5 N."""
_CONTACT_SHARE = 0.35  # of the deepest point: what is deeper touches (`control.tactile.force`)
_WIDTH = 320  # px
_PERCENTILES = (50, 75, 90, 97, 99.5)
_COUNTS = (3, 6, 12, 24)  # counts of change; the areas above them are statistics
_MIN_FRAMES = 50


@dataclass(frozen=True, eq=False)
class ImageForce:
    """Ridge regression from `change_statistics`, perhaps with `contact_shape`, to force (N).

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
    """Fit forces (N) to the statistics of grasps on a load cell, untouched frames included.

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
    """Return the roots of strength and extent of the change from the untouched image (`resized`)."""
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
    return np.sqrt(plain)


def contact_shape(depth: Map, pixel_pitch: float) -> Float[np.ndarray, " 4"]:
    """Return the roots of the contact's volume, area, perimeter and depth, in mm.

    `depth` in m, `pixel_pitch` in m per px. Bodies of one depth are as hard pressed as they are large.
    """
    pitch, deepest = 1e3 * pixel_pitch, 1e3 * max(float(depth.max()), 0.0)
    contact = 1e3 * depth > _CONTACT_SHARE * max(deepest, 1e-6)
    outlines, _ = cv2.findContours(contact.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    perimeter = pitch * sum(cv2.arcLength(outline, True) for outline in outlines)
    volume = 1e3 * float(depth[contact].sum()) * pitch**2
    return np.sqrt([volume, contact.sum() * pitch**2, perimeter, deepest])

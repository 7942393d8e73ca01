"""Depth of a gel from an image, by inverting the sensor file's model.

One colour may belong to two slopes, to a shadow or to a depth, so Gauss-Newton steps find the
surface whose image (`sensor_calibration.shade`) fits the frame. A step is a Poisson-like equation
with free (Neumann) borders, solved by conjugate gradients that the cosine transform preconditions.
Coarse grids come first: they cost little.
"""

import cv2
import numpy as np
from jaxtyping import Float32

from touchgoal.control.arrays import Counts, Image, Map
from touchgoal.control.tactile import depth_steps
from touchgoal.control.tactile.background import cosines
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.control.tactile.sensor_calibration import (
    SensorCalibration,
    illumination,
    position_terms,
    shadows,
)

Colours = Float32[np.ndarray, "3 h w"]

_SCHEDULE = ((8, 5, 3), (4, 3, 2), (2, 1, 0))  # (cell's side in px, steps, of these with a search)
_INNER = 5  # conjugate gradient steps to a Gauss-Newton step
_MODEL_ERROR = 0.5  # counts by which a perfect calibration still differs from the image
_OUTLIER = 4.0  # standard deviations beyond which a pixel counts less
_DAMPING = 0.01  # share of the usual curvature
# Prior where colours leave the depth open: the lowest tenth of the surface is gel at rest, within
# _REST of zero, counted once per patch of _PATCH pixels.
_FLAT = 4e-6  # m around its upper end
_REST = 40e-6  # m
_PATCH = 400
# A pixel that fits badly is tried at _LENGTHS other slopes in the same direction, and takes one
# that leaves _BETTER of its squared error.
_LENGTHS = 12
_BETTER = 0.25
_TILTED = 0.05  # slope below which the direction is noise


class DepthEstimator:
    """Reconstruction of the gel's surface from single frames of one sensor.

    Walls steeper than the file's `max_slope` read too low, unless the depth's own colour (up to
    `max_depth`) shows how deep they go. Where colours do not determine the depth, the lowest tenth
    of the surface counts as gel at rest: too shallow if a contact fills the view. `finest` is the
    side of the smallest cells, px: 8 takes a third of the time of 2 and finds the deepest point of
    most contacts as well.
    """

    def __init__(self, calibration: SensorCalibration, finest: int = 2) -> None:
        self.calibration = calibration
        self._schedule = [step for step in _SCHEDULE if step[0] >= finest]
        self._levels = [_Level(calibration, cell) for cell, *_ in self._schedule]

    def estimate(self, image: Image, background: Counts | None = None) -> Map:
        """Return the depth of the gel below its rest plane in an RGB frame, m, positive inwards.

        The background is the untouched sensor now (`Background.image`), or else the sensor file's.
        Paint markers over in both first (`markers.without_markers`).
        """
        if background is None:
            background = self.calibration.background.astype(np.float32)
        change = remove_gain(image, background) - background
        surface = np.zeros((1, 1), np.float32)
        for level, (_, steps, searched) in zip(self._levels, self._schedule, strict=True):
            surface = level.refine(surface, change, steps, searched)
        h, w, _ = image.shape
        return cv2.resize(surface, (w, h), interpolation=cv2.INTER_LINEAR)


class _Level:
    """Image model and its inverse at one cell size."""

    def __init__(self, calibration: SensorCalibration, cell: int) -> None:
        p = self._calibration = calibration
        rows, columns, _ = p.background.shape
        h, w = self._shape = rows // cell, columns // cell
        self._pitch = p.pixel_pitch * cell
        gain = illumination(p.background, p.illumination_exponent)
        light = cv2.resize(gain, (w, h), interpolation=cv2.INTER_AREA)
        self._gain = np.ascontiguousarray(np.moveaxis(light, 2, 0))
        self._noise = np.float32(np.hypot(p.noise / cell, _MODEL_ERROR))
        self._rest = np.float32(cell**2 / _PATCH / _REST**2)
        u, v = np.linspace(-1, 1, w), np.linspace(-1, 1, h)[:, None]
        # Without variation over the image, the most common, it is faster.
        n = p.response.shape[2] if p.response[..., 1:].any() else 1
        self._places = position_terms(u, v, n).astype(np.float32)
        waves = len(self._places)
        self._coefficients = _coefficients(p.response[..., :waves])
        per_depth = np.tensordot(p.response[:, 9, :waves], self._places, 1)
        self._per_depth = (self._gain * per_depth).astype(np.float32)
        # Cosine transforms of these sizes are faster as matrix products than by cv2.dct.
        self._down, self._across = cosines(h, h), cosines(w, w)
        down, across = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (h, w))
        self._half = np.float32(0.5 / self._pitch)
        lengths = np.linspace(0, p.max_slope, _LENGTHS + 2)[1:-1]
        self._lengths = lengths.astype(np.float32)
        self._laplace = ((down[:, None] + across) / self._pitch**2).astype(np.float32)

    def refine(
        self,
        start: Float32[np.ndarray, "_ _"],
        change: Float32[np.ndarray, "H W 3"],
        steps: int,
        searched: int,
    ) -> Map:
        """Improve a surface (m) by Gauss-Newton; the last `searched` steps may jump."""
        h, w = self._shape
        target = cv2.resize(change, (w, h), interpolation=cv2.INTER_AREA)
        target = np.ascontiguousarray(np.moveaxis(target, 2, 0))
        surface = cv2.resize(start, (w, h), interpolation=cv2.INTER_LINEAR)
        for step in range(steps):
            linear = self._linearise(target, surface, search=step >= steps - searched)
            surface = surface + self._solve(*depth_steps.normal_equations(*linear), surface)
        return surface

    def _linearise(
        self, target: Colours, surface: Map, search: bool
    ) -> tuple[Colours, Colours, Colours, Colours, Map]:
        """Return the image's error (counts), its derivatives by slopes and depth, and weights."""
        p = self._calibration
        gx, gy = np.empty_like(surface), np.empty_like(surface)
        depth_steps.slopes(surface, self._half, gx, gy)
        dark = shadows(p, surface, self._pitch)
        # The change that remains for the slopes to explain.
        left = target - self._per_depth * np.minimum(surface, np.float32(p.max_depth))
        left -= self._gain * np.tensordot(p.shadow, dark, 1)
        model = self._gain, self._places, self._coefficients
        steepest = np.float32(p.max_slope)
        shading, by_gx, by_gy = depth_steps.shading(gx, gy, *model, steepest)
        error = left - shading
        outlier = np.float32((_OUTLIER * self._noise) ** 2)
        new_x, new_y, moved = gx, gy, False
        if search:
            new_x, new_y, moved = depth_steps.best_slopes(
                *(left, error, gx, gy, *model, self._lengths, outlier),
                *(np.float32(_TILTED**2), np.float32(_BETTER)),
            )
        if moved:
            shading, by_gx, by_gy = depth_steps.shading(new_x, new_y, *model, steepest)
            error = left - shading
        size = np.sqrt(np.einsum("chw,chw->hw", error, error)) / self._noise
        weight = self._noise**-2 / np.maximum(size / np.float32(_OUTLIER), 1)
        if moved:
            error += by_gx * (new_x - gx) + by_gy * (new_y - gy)
        return error, by_gx, by_gy, self._per_depth * (surface < p.max_depth), weight

    def _solve(
        self,
        curvature: Float32[np.ndarray, "6 h w"],
        slope: Float32[np.ndarray, "3 h w"],
        surface: Map,
    ) -> Map:
        """Return the Gauss-Newton step, by preconditioned conjugate gradients."""
        usual = (curvature[0].mean() + curvature[2].mean()) / 2
        curvature[0] += np.float32(_DAMPING) * usual
        curvature[2] += np.float32(_DAMPING) * usual
        tenth = surface.size // 10
        lowest = np.partition(surface, tenth, axis=None)[tenth]
        rest = self._rest / (1 + ((surface - lowest) / np.float32(_FLAT)) ** 2)
        curvature[5] += rest
        residual = slope[2] - rest * surface
        depth_steps.add_against_slopes(slope[0], slope[1], self._half, residual)
        smooth = 1 / (usual * self._laplace + curvature[5].mean())
        return depth_steps.conjugate_gradients(
            curvature, residual, smooth, self._down, self._across, self._half, _INNER
        )


def _coefficients(response: Float32[np.ndarray, "3 10 waves"]) -> Float32[np.ndarray, "rows 10"]:
    """Return the coefficients of 1 and the normal's `monomials`: by colour, x, y; R, G, B; position."""
    r = np.moveaxis(response, 2, 1)  # channel, wave, feature
    out = np.zeros((3, *r.shape[:2], 10), np.float32)
    out[0, ..., 1:] = r[..., :9]
    for column, (feature, factor) in enumerate(((0, 1), (2, 2), (3, 1), (5, 3), (6, 2), (7, 1))):
        out[1, ..., column] = factor * r[..., feature]
    for column, (feature, factor) in enumerate(((1, 1), (3, 1), (4, 2), (6, 1), (7, 2), (8, 3))):
        out[2, ..., column] = factor * r[..., feature]
    return out.reshape(-1, 10)

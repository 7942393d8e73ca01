"""From a sensor's picture to the depth of its gel: the sensor file's model, turned round.

One colour may belong to two slopes, to a shadow or to a depth, so pixels are not inverted one by
one. The surface is sought as a whole whose picture (`sensor_calibration.shade`) is the frame, by Gauss-Newton
steps on the squared error: every pixel is read in the light of its neighbours, and what comes out is
a surface. A step is a Poisson-like equation with free (Neumann) borders, solved by conjugate
gradients that the cosine transform preconditions. Coarse grids come first: they cost little.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.tactile.background import cosines
from touchgoal.control.tactile.sensor_calibration import (
    SensorCalibration,
    illumination,
    monomials,
    shadows,
)

Map = Float32[np.ndarray, "h w"]
Colours = Float32[np.ndarray, "3 h w"]

# (pixels to a cell's side, Gauss-Newton steps, of these with a search, conjugate gradient steps)
_SCHEDULE = ((8, 5, 3, 5), (4, 3, 2, 5), (2, 1, 0, 5))
_MODEL_ERROR = 0.5  # counts by which a perfect calibration still differs from the picture
_OUTLIER = 4.0  # standard deviations beyond which a pixel counts less
_DAMPING = 0.01  # of the usual curvature
# The lowest tenth of the surface is believed to be gel at rest: to lie within _REST, once for each
# patch of _PATCH pixels. It decides where the colours themselves do not tell the depth.
_FLAT = 4e-6  # m around its upper end
_REST = 40e-6  # m
_PATCH = 400
# A pixel that fits badly is tried at _LENGTHS other slopes in the same direction, and takes one
# that leaves _BETTER of its squared error.
_LENGTHS = 12
_BETTER = 0.25
_TILTED = 0.05  # slope below which the direction is noise


class DepthEstimator:
    """Reconstructs the gel's surface from single frames of one sensor.

    What the sensor file does not tell apart, no frame shows. Walls steeper than its `max_slope` come
    out too low, except where the depth's own colour (up to `max_depth`) says how deep they go. Without
    such a colour, depth counts from the lowest tenth of what is seen: too shallow where a contact
    fills the view.

    Args:
        calibration: the sensor file.
        finest: side of the smallest cells, px. 8 takes a third of the time of 2 and finds the
            deepest point of most contacts as well.
    """

    def __init__(self, calibration: SensorCalibration, finest: int = 2) -> None:
        self._calibration = calibration
        self._schedule = [step for step in _SCHEDULE if step[0] >= finest]
        self._levels = [_Level(calibration, cell) for cell, *_ in self._schedule]

    def estimate(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        background: Float32[np.ndarray, "h w 3"] | None = None,
    ) -> Map:
        """Depth of the gel's surface below its rest plane, m, positive where pressed in.

        Args:
            image: RGB frame; paint markers over first (`markers.without_markers`).
            background: the untouched sensor as it is now (`background.Background.image`), markers
                painted over as well; None: the sensor file's.
        """
        if background is None:
            background = self._calibration.background.astype(np.float32)
        change = image - background
        surface = np.zeros((1, 1), np.float32)
        for level, (_, steps, searched, inner) in zip(self._levels, self._schedule, strict=True):
            surface = level.refine(surface, change, steps, searched, inner)
        h, w, _ = image.shape
        return cv2.resize(surface, (w, h), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True)
class _Linear:
    """The picture near a surface: error (counts), its derivatives by slopes and depth, weights."""

    error: Colours
    by_gx: Colours
    by_gy: Colours
    by_depth: Colours
    weight: Map


class _Level:
    """The model of the picture and its inverse on cells of some pixels."""

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
        places = np.stack(np.broadcast_arrays(1, u, v)).astype(np.float32)
        self._places = places if p.response[..., 1:].any() else places[:1]  # the most common, fast
        waves = len(self._places)
        self._coefficients = _coefficients(p.response[..., :waves])
        per_depth = np.tensordot(p.response[:, 9, :waves], self._places, 1)
        self._per_depth = (self._gain * per_depth).astype(np.float32)
        # As products, cosine transforms of these sizes are faster than cv2.dct.
        self._down, self._across = cosines(h, h), cosines(w, w)
        down, across = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (h, w))
        self._laplace = ((down[:, None] + across) / self._pitch**2).astype(np.float32)

    def refine(
        self,
        start: Float32[np.ndarray, "_ _"],
        change: Float32[np.ndarray, "H W 3"],
        steps: int,
        searched: int,
        inner: int,
    ) -> Map:
        """From a start (of any resolution) towards the surface that makes the change.

        Args:
            start: m.
            change: of the picture to the untouched one, counts.
            steps: of Gauss-Newton.
            searched: the last how many of them may jump to other slopes.
            inner: conjugate gradient steps in each.
        """
        h, w = self._shape
        seen = cv2.resize(change, (w, h), interpolation=cv2.INTER_AREA)
        seen = np.ascontiguousarray(np.moveaxis(seen, 2, 0))
        surface = cv2.resize(start, (w, h), interpolation=cv2.INTER_LINEAR)
        for step in range(steps):
            linear = self._linearise(seen, surface, search=step >= steps - searched)
            surface = surface + self._solve(linear, surface, inner)
        return surface

    def _linearise(self, seen: Colours, surface: Map, search: bool) -> _Linear:
        p = self._calibration
        gx, gy = self._slopes(surface)
        dark = shadows(p, surface, self._pitch)
        # What shadows and depth leave for the slopes to explain.
        left = seen - self._per_depth * np.minimum(surface, np.float32(p.max_depth))
        left -= self._gain * np.tensordot(p.shadow, dark, 1)
        shading, by_gx, by_gy = self._shading(gx, gy)
        error = left - shading
        moved = self._search(left, error, gx, gy) if search else None
        if moved is not None:
            shading, by_gx, by_gy = self._shading(*moved)
            error = left - shading
        size = np.sqrt(np.einsum("chw,chw->hw", error, error)) / self._noise
        weight = self._noise**-2 / np.maximum(size / np.float32(_OUTLIER), 1)
        if moved is not None:
            error += by_gx * (moved[0] - gx) + by_gy * (moved[1] - gy)
        return _Linear(error, by_gx, by_gy, self._per_depth * (surface < p.max_depth), weight)

    def _shading(self, gx: Map, gy: Map) -> tuple[Colours, Colours, Colours]:
        """What slopes add to the picture, and the derivatives of that by gx and gy."""
        p = self._calibration
        square = gx * gx + gy * gy
        steep = square > (1 + square) * np.float32(p.max_slope**2)
        # n = -g / length; beyond `max_slope` only the direction of g counts.
        squared = np.where(steep, square / np.float32(p.max_slope**2), 1 + square)
        bend = np.where(steep, 1 / np.maximum(square, 1e-6), 1 / squared)
        inverse = -1 / np.sqrt(squared)
        terms = self._coefficients @ _terms(gx * inverse, gy * inverse).reshape(10, -1)
        terms = terms.reshape(3, 3, len(self._places), *self._shape)
        value, by_nx, by_ny = self._gain * np.einsum("dcphw,phw->dchw", terms, self._places)
        # dn/dg = -(1 - bend g g^T) / length
        bend *= inverse
        xx, xy, yy = inverse - bend * gx * gx, -bend * gx * gy, inverse - bend * gy * gy
        return value, by_nx * xx + by_ny * xy, by_nx * xy + by_ny * yy

    def _search(self, left: Colours, error: Colours, gx: Map, gy: Map) -> tuple[Map, Map] | None:
        """Slopes, where some others in their direction fit the colours much better; else None."""
        before = np.einsum("chw,chw->hw", error, error)
        square = gx * gx + gy * gy
        bad = (before > (_OUTLIER * self._noise) ** 2) & (square > _TILTED**2)
        i, j = np.nonzero(bad)
        if not len(i):
            return None
        lengths = np.linspace(0, self._calibration.max_slope, _LENGTHS + 2)[1:-1].astype(np.float32)
        slope = np.sqrt(square[i, j])
        x, y = (-lengths[:, None] * g[i, j] / slope for g in (gx, gy))
        values = self._coefficients[: 3 * len(self._places)] @ _terms(x, y).reshape(10, -1)
        values = values.reshape(3, len(self._places), *x.shape)
        values = np.einsum("cpkn,pn->ckn", values, self._places[:, i, j])
        errors = left[:, i, j][:, None] - self._gain[:, i, j][:, None] * values
        after = np.einsum("ckn,ckn->kn", errors, errors)
        n = lengths[after.argmin(0)]
        factor = np.where(
            after.min(0) < _BETTER * before[i, j], n / np.sqrt(1 - n * n) / slope, np.float32(1)
        )
        scale = np.ones_like(gx)
        scale[i, j] = factor
        return gx * scale, gy * scale

    def _solve(self, linear: _Linear, surface: Map, inner: int) -> Map:
        """The step that Gauss and Newton would take: preconditioned conjugate gradients."""
        jx, jy, jh = linear.by_gx, linear.by_gy, linear.by_depth
        wx, wy, wh = jx * linear.weight, jy * linear.weight, jh * linear.weight
        a, b, c = _dot(wx, jx), _dot(wx, jy), _dot(wy, jy)
        d, e, f = _dot(wx, jh), _dot(wy, jh), _dot(wh, jh)
        usual = (a.mean() + c.mean()) / 2
        a += np.float32(_DAMPING) * usual
        c += np.float32(_DAMPING) * usual
        tenth = surface.size // 10
        lowest = np.partition(surface, tenth, axis=None)[tenth]
        rest = self._rest / (1 + ((surface - lowest) / np.float32(_FLAT)) ** 2)
        f += rest
        residual = self._against_slopes(_dot(wx, linear.error), _dot(wy, linear.error))
        residual += _dot(wh, linear.error) - rest * surface
        smooth = 1 / (usual * self._laplace + f.mean())
        step = np.zeros_like(surface)
        direction, size = step, np.float32(1)
        for _ in range(inner):
            z = self._down.T @ (self._down @ residual @ self._across.T * smooth) @ self._across
            before, size = size, np.vdot(residual, z)
            if size == 0:  # nothing left to explain: a frame equal to its background
                break
            direction = z + size / before * direction
            gx, gy = self._slopes(direction)
            curved = self._against_slopes(
                a * gx + b * gy + d * direction, b * gx + c * gy + e * direction
            )
            curved += d * gx + e * gy + f * direction
            length = size / np.vdot(direction, curved)
            step += length * direction
            residual -= length * curved
        return step

    def _slopes(self, surface: Map) -> tuple[Map, Map]:
        """Central differences, the edge replicated, as in `sensor_calibration.shape_features`."""
        p = cv2.copyMakeBorder(surface, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
        half = np.float32(0.5 / self._pitch)
        return (p[1:-1, 2:] - p[1:-1, :-2]) * half, (p[2:, 1:-1] - p[:-2, 1:-1]) * half

    def _against_slopes(self, x: Map, y: Map) -> Map:
        """The transpose of `_slopes`."""
        out = np.zeros_like(x)
        out[:, 1:] += x[:, :-1]
        out[:, :-1] -= x[:, 1:]
        out[:, -1] += x[:, -1]
        out[:, 0] -= x[:, 0]
        out[1:] += y[:-1]
        out[:-1] -= y[1:]
        out[-1] += y[-1]
        out[0] -= y[0]
        out *= np.float32(0.5 / self._pitch)
        return out


def _dot(a: Colours, b: Colours) -> Map:
    return np.einsum("chw,chw->hw", a, b)


def _terms(
    x: Float32[np.ndarray, "a b"], y: Float32[np.ndarray, "a b"]
) -> Float32[np.ndarray, "10 a b"]:
    """1 and the monomials: what they and their derivatives are made of."""
    return np.concatenate([np.ones((1, *x.shape), np.float32), monomials(x, y)])


def _coefficients(response: Float32[np.ndarray, "3 10 waves"]) -> Float32[np.ndarray, "rows 10"]:
    """What `_terms` of the normal (x, y) are multiplied by.

    Rows: the colour, its derivative by x, by y; each for R, G, B; each for 1, u, v.
    """
    r = np.moveaxis(response, 2, 1)  # channel, wave, feature
    out = np.zeros((3, *r.shape[:2], 10), np.float32)
    out[0, ..., 1:] = r[..., :9]
    for column, (feature, factor) in enumerate(((0, 1), (2, 2), (3, 1), (5, 3), (6, 2), (7, 1))):
        out[1, ..., column] = factor * r[..., feature]
    for column, (feature, factor) in enumerate(((1, 1), (3, 1), (4, 2), (6, 1), (7, 2), (8, 3))):
        out[2, ..., column] = factor * r[..., feature]
    return out.reshape(-1, 10)

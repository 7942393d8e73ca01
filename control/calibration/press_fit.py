"""Steps of the fit of a sensor's light and gel to ball presses.

With the surface under each press known, the change of colour is linear in the response
(`sensor_calibration.design_matrix`): least squares. It alternates with steps that move the circles
(hand-made ones are off by pixels) and that select the non-linear parameters by cross-validation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int

from touchgoal.control.arrays import Circle, Circles, Image
from touchgoal.control.calibration.ball import press_surface, squared_distance
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.tactile.sensor_calibration import (
    N_FEATURES,
    SensorCalibration,
    coefficients,
    design_matrix,
    illumination,
)

REGION = 3.0
"""Radius of the region that is fitted and judged around a press, in labelled contact radii."""
NARROWEST, WIDEST = 2.0, 0.98  # contact radius: px at least, and as a share of the ball's at most
BLUR_PYRAMID = (3.0e-3, 1.5e-3, 0.75e-3, 0.35e-3)
"""Standard deviations of Taxim's gel, m; one factor scales them all."""

_PIXELS = 5000  # pixels of a press that take part in the fit, at most
_LIGHTS = 3  # lights whose shadows are fitted
_FOLDS = 4
_MOVES = 8  # Gauss-Newton steps of a circle
_RIDGE = 1e-3  # share of each term's own energy; 1e-4 to 1e-2 give nearly the same held-out error
# Candidates of cross-validation.
BLUR_SCALES = (0.15, 0.25, 0.35, 0.5, 0.7, 1.0)
_SHADOW_SLOPES = (0.05, 0.1, 0.2, 0.4, 0.8)
_PENUMBRAS = (0.03e-3, 0.1e-3, 0.3e-3, 1e-3)
_LABEL_SCALES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1)
_COMMON_SCALES = (0.65, 0.8, 1.0, 1.25)
_BALLS_PER_CONTACT = (1.1, 1.3, 1.6, 2.0, 2.5, 3.5)

Weights = Float64[np.ndarray, "3 terms"]


@dataclass(frozen=True)
class FitState:
    """Sensor file so far; circle (px) and ball's radius (m) of each press."""

    calibration: SensorCalibration
    circles: Circles
    ball_radius: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class _Sample:
    """Fitted pixels of one press: flat indices, and change of colour."""

    pixels: Int[np.ndarray, " n"]
    change: Float32[np.ndarray, "n 3"]


@dataclass(frozen=True)
class _NormalEquations:
    """Normal equations of one press, per channel."""

    square: Float64[np.ndarray, "3 terms terms"]
    product: Float64[np.ndarray, "3 terms"]
    energy: float

    def loss(self, solved: Weights) -> float:
        """Return the summed squared error (counts^2) of these weights."""
        fitted = np.einsum("ci,cij,cj->", solved, self.square, solved)
        return self.energy - 2 * float((self.product * solved).sum()) + float(fitted)


class PressFit:
    """Steps of the fit to presses; each takes a state and returns a better one.

    Changes are taken against the untouched `background`. `varies_over_image` says whether the
    response may vary over the image, `trust_labels` whether circles stay as they are.
    """

    def __init__(
        self,
        presses: PressSet,
        background: Image,
        varies_over_image: bool,
        illumination_exponent: float,
        trust_labels: bool = False,
    ) -> None:
        self._labels = presses.circles
        self._trust_labels = trust_labels
        self._light = illumination(background, illumination_exponent).reshape(-1, 3)
        self._samples = [
            _sample(image, background, circle)
            for image, circle in zip(presses.images, presses.circles, strict=True)
        ]
        self._varies = varies_over_image

    def initialise(
        self, initial: SensorCalibration, ball_radius: Float64[np.ndarray, " n"]
    ) -> FitState:
        """Start with the common scale of the labelled radii that explains the images best.

        An unknown ball (NaN) begins at twice the radius of the largest contact.
        """
        starts = []
        for scale in _LABEL_SCALES:
            circles = self._labels * [1, 1, scale]
            contact = circles[:, 2] * initial.pixel_pitch
            ball = np.where(np.isnan(ball_radius), 2 * contact.max(), ball_radius)
            if (contact < WIDEST * ball).all():
                starts.append(FitState(initial, circles, ball))
        return self._best(starts)

    def select_hyperparameters(self, state: FitState) -> FitState:
        """Select gel and shadow parameters by cross-validation, one after the other."""
        state = self._select_blur(state)
        state = self._select_value(state, "shadow_slope", _SHADOW_SLOPES)
        return self._select_value(state, "penumbra", _PENUMBRAS)

    def alternate(self, state: FitState, rounds: int) -> FitState:
        """Fit response and circles in turn."""
        for _ in range(rounds):
            state = self.fit_response(state)
            if not self._trust_labels:
                state = self.fit_circles(state)
        return state

    def fit_common_scale(self, state: FitState) -> FitState:
        """Scale all contacts and balls together if that explains the images better.

        Scaling alone converges slowly: a weaker response to steeper slopes, or a wider bulge around
        a smaller contact, looks nearly the same.
        """
        candidates = []
        for scale in _COMMON_SCALES:
            circles = state.circles * [1, 1, scale]
            resized = replace(state, circles=circles, ball_radius=state.ball_radius * scale)
            candidates.append(self._select_blur(self.alternate(resized, 2)))
        return self._best(candidates)

    def fit_ball_radius(self, state: FitState) -> FitState:
        """Select the ball radius (one for all presses) that explains the images best."""
        widest = state.circles[:, 2].max() * state.calibration.pixel_pitch
        balls = [np.full(len(state.circles), ratio * widest) for ratio in _BALLS_PER_CONTACT]
        return self._best([self.alternate(replace(state, ball_radius=ball), 2) for ball in balls])

    def fit_response(self, state: FitState) -> FitState:
        """Fit the response, and set the lights to its directions."""
        for _ in range(2):  # where the lights stand decides where shadows fall
            solved = self._solve(self._normal_equations(state))
            state = replace(state, calibration=_with_response(state.calibration, solved))
        return state

    def fit_circles(self, state: FitState) -> FitState:
        """Move every circle towards its image."""
        everything = zip(state.circles, state.ball_radius, self._samples, self._labels, strict=True)
        moved = [self._refine_circle(state.calibration, *press) for press in everything]
        return replace(state, circles=np.stack(moved))

    def _select_blur(self, state: FitState) -> FitState:
        pyramids = [tuple(scale * sigma for sigma in BLUR_PYRAMID) for scale in BLUR_SCALES]
        return self._select_value(state, "blur_sigmas", pyramids)

    def _select_value(self, state: FitState, name: str, values: Sequence[Any]) -> FitState:
        """Select the value of one parameter by cross-validation."""
        calibrations = [replace(state.calibration, **{name: value}) for value in values]
        return self._best([replace(state, calibration=p) for p in calibrations])

    def _best(self, candidates: Sequence[FitState]) -> FitState:
        return min(candidates, key=self._held_out_loss)

    def _held_out_loss(self, state: FitState) -> float:
        """Return the summed squared error (counts^2) of presses predicted without their fold."""
        normals = self._normal_equations(state)
        loss = 0.0
        for fold in range(_FOLDS):
            solved = self._solve([n for i, n in enumerate(normals) if i % _FOLDS != fold])
            loss += sum(n.loss(solved) for n in normals[fold::_FOLDS])
        return loss

    def _normal_equations(self, state: FitState) -> list[_NormalEquations]:
        everything = zip(state.circles, state.ball_radius, self._samples, strict=True)
        normals = []
        for circle, ball, sample in everything:
            surface = press_surface(state.calibration, circle, ball)
            terms = design_matrix(state.calibration, surface, sample.pixels).astype(np.float64)
            lit = [terms * self._light[sample.pixels, channel] for channel in range(3)]
            squares = np.stack([x @ x.T for x in lit])
            products = np.stack([x @ sample.change[:, c] for c, x in enumerate(lit)])
            energy = float((sample.change.astype(np.float64) ** 2).sum())
            normals.append(_NormalEquations(squares, products, energy))
        return normals

    def _solve(self, normals: Sequence[_NormalEquations]) -> Weights:
        product = np.sum([n.product for n in normals], 0)
        square = np.sum([n.square for n in normals], 0)
        solved = np.zeros_like(product)
        used = np.ones(product.shape[1], bool)
        used[N_FEATURES:-_LIGHTS] = self._varies
        for channel in range(3):
            part = square[channel][np.ix_(used, used)]
            energy = np.diag(part)
            ridge = np.diag(_RIDGE * energy + 1e-12 * energy.max())
            solved[channel, used] = np.linalg.solve(part + ridge, product[channel, used])
        return solved

    def _refine_circle(
        self,
        calibration: SensorCalibration,
        circle: Circle,
        ball: float,
        sample: _Sample,
        label: Circle,
    ) -> Circle:
        """Take one damped Gauss-Newton step of centre and radius."""
        model, step = coefficients(calibration), 0.25
        light = self._light[sample.pixels]
        widest = WIDEST * ball / calibration.pixel_pitch

        def bounded(at: Circle) -> Circle:
            x, y, radius = label
            least = [x - radius, y - radius, NARROWEST]
            return at.clip(least, [x + radius, y + radius, min(1.5 * radius, widest)])

        def residual(at: Circle) -> Float32[np.ndarray, " m"]:
            surface = press_surface(calibration, bounded(at), ball)
            terms = design_matrix(calibration, surface, sample.pixels)
            return ((model @ terms).T * light - sample.change).ravel()

        here = residual(circle)
        jacobian = np.stack([(residual(circle + step * e) - here) / step for e in np.eye(3)], 1)
        curvature = jacobian.T @ jacobian
        curvature += np.diag(0.01 * np.diag(curvature) + 1e-6)
        move = -np.linalg.solve(curvature, jacobian.T @ here).clip(-3, 3)
        for shorter in (1.0, 0.3, 0.1):
            there = bounded(circle + shorter * move)
            if (residual(there) ** 2).sum() < (here**2).sum():
                return there
        return circle


def move_circles(calibration: SensorCalibration, presses: PressSet, start: Circles) -> Circles:
    """Return the circles (px) that best explain presses of known balls by a sensor file.

    The presses are in the light of the file's background; the search begins at `start` and is
    bounded by the circles of the presses.
    """
    widest = WIDEST * presses.ball_radius / calibration.pixel_pitch
    circles = np.array(start, np.float64)
    circles[:, 2] = circles[:, 2].clip(NARROWEST, widest)
    steps = PressFit(presses, calibration.background, True, calibration.illumination_exponent)
    state = FitState(calibration, circles, presses.ball_radius)
    for _ in range(_MOVES):
        state = steps.fit_circles(state)
    return state.circles


def _sample(image: Image, background: Image, circle: Circle) -> _Sample:
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    reach = REGION * circle[2]
    stride = max(1, round(math.sqrt(math.pi * reach**2 / _PIXELS)))
    near = squared_distance(image.shape, circle) < reach**2
    pixels = np.flatnonzero(near & (rows % stride == 0) & (columns % stride == 0))
    change = image.reshape(-1, 3)[pixels].astype(np.float32) - background.reshape(-1, 3)[pixels]
    return _Sample(pixels, change)


def _with_response(calibration: SensorCalibration, solved: Weights) -> SensorCalibration:
    response, shadow = np.split(solved.astype(np.float32), [-_LIGHTS], 1)
    response = response.reshape(3, -1, N_FEATURES).transpose(0, 2, 1)
    azimuths = np.degrees(np.arctan2(response[:, 1, 0], response[:, 0, 0]))
    return replace(
        calibration,
        response=response,
        shadow=shadow,
        light_azimuths=tuple(float(a) for a in azimuths),
    )

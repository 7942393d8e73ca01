"""Fit of a sensor file to ball presses."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.arrays import Circle, Circles, Counts, Image, Map
from touchgoal.control.calibration import press_fit
from touchgoal.control.calibration.ball import (
    DepthErrors,
    press_surface,
    sphere_in,
    squared_distance,
)
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.sensor_calibration import (
    N_FEATURES,
    SensorCalibration,
    shade,
    shape_features,
)

ILLUMINATION_EXPONENTS = (1.0, 1.5, 2.0, 2.5)  # candidates of `select_illumination_exponent`
STEPS = 5  # how often `fit` reports progress
SQUARES_MINIMUM = 40
"""Least number of presses for `squares`; tested on 46 presses, up to six of them left out."""

# Position terms need presses spread over the image: the standard deviation of the centres, as a
# share of the image, in both directions (evenly spread over all of it: 0.29).
_MIN_SPREAD = 0.1
_WINDOWS = (4.0, 8.0, 16.0, 32.0, 64.0)  # px
_DEPTH_PRESSES = 12  # presses whose depth decides on the illumination exponent
_FAR = 4.0  # contact radii beyond which a press does not change the background


@dataclass(frozen=True)
class FittedCalibration:
    """Fitted sensor, with the circles of its presses."""

    calibration: SensorCalibration  # the sensor file
    circles: Circles  # of the fitted presses, moved to their images, px
    # of the fitted presses, m; unknown ones are fitted, but images determine them poorly
    ball_radius: Float[np.ndarray, " n"]
    varies_over_image: bool  # whether the response varies; not if all presses lie in one place
    # x, y and radius of the true circle (px) are about label_offset + label_slope * label
    label_offset: Circle
    label_slope: Circle

    def correct_labels(self, presses: PressSet) -> Circles:
        """Predict the circles of other presses (px) from their labels alone."""
        circles = self.label_offset + self.label_slope * presses.circles
        widest = press_fit.WIDEST * presses.ball_radius / self.calibration.pixel_pitch
        circles[:, 2] = circles[:, 2].clip(press_fit.NARROWEST, widest)
        return circles

    def fit_circles(self, presses: PressSet) -> Circles:
        """Move the circles (px) of other presses from their labels to their images.

        Errors at these circles come from the model alone; errors at `correct_labels` include label
        errors.
        """
        return press_fit.move_circles(self.calibration, presses, self.correct_labels(presses))

    def simulate(self, presses: PressSet, circles: Circles) -> list[Counts]:
        """Render presses of these balls at circles (px): RGB counts without noise."""
        calibration = self.calibration
        return [
            shade(calibration, press_surface(calibration, circle, ball))
            for circle, ball in zip(circles, presses.ball_radius, strict=True)
        ]


def fit(
    presses: PressSet,
    pitch: float,
    sensor: str,
    on_progress: Callable[[], object] = lambda: None,
    trust_labels: bool = False,
    illumination_exponent: float = 1.0,
    squares: bool = False,
) -> FittedCalibration:
    """Fit a sensor file to presses at a pitch (m per pixel).

    `on_progress` is called STEPS times. With `trust_labels` the circles stay as they are, but for
    one common scale of their radii. `illumination_exponent`: see `select_illumination_exponent`.
    With `squares` the response also varies with the squared position, for gels whose light falls
    off towards the borders.
    """
    background, (rows, columns) = median_background(presses), presses.background.shape[:2]
    spread = presses.circles[:, :2].std(0)
    varies_over_image = bool((spread > _MIN_SPREAD * np.array([columns, rows])).all())
    steps = press_fit.PressFit(
        presses, background, varies_over_image, illumination_exponent, trust_labels
    )
    initial = SensorCalibration(  # A typical gel, still without response and limits.
        sensor=sensor,
        background=background,
        pixel_pitch=pitch,
        response=np.zeros((3, N_FEATURES, 5 if squares else 3), np.float32),
        light_azimuths=(0.0, 0.0, 0.0),
        shadow_slope=0.1,
        shadow=np.zeros((3, 3), np.float32),
        penumbra=0.1e-3,
        max_slope=math.inf,
        max_depth=math.inf,
        blur_sigmas=tuple(0.35 * sigma for sigma in press_fit.BLUR_PYRAMID),
        noise=_noise(presses),
        illumination_exponent=illumination_exponent,
    )
    state = steps.initialise(initial, presses.ball_radius)
    on_progress()
    for _ in range(2):
        state = steps.select_hyperparameters(steps.fit_response(state))
        on_progress()
        state = steps.alternate(state, 3)
        if np.isnan(presses.ball_radius).any():
            state = steps.fit_ball_radius(steps.fit_common_scale(state))
        on_progress()
    state = steps.fit_response(steps.alternate(state, 3))
    calibration, label_line = _with_limits(state), _label_line(presses.circles, state.circles)
    return FittedCalibration(
        calibration, state.circles, state.ball_radius, varies_over_image, *label_line
    )


def select_illumination_exponent(
    presses: PressSet,
    pitch: float,
    sensor: str,
    on_progress: Callable[[], object] = lambda: None,
    squares: bool = False,
) -> float:
    """Return the illumination exponent with which depth shows these balls at their true radius.

    The image error cannot decide: it is the same for all within a hundredth of a count.

    `pitch` is m per pixel; `on_progress` is called after each exponent; `squares` as in `fit`.
    """
    wrong = {}
    chosen = np.arange(0, len(presses), max(1, len(presses) // _DEPTH_PRESSES))
    for power in ILLUMINATION_EXPONENTS:
        fitted = fit(presses, pitch, sensor, illumination_exponent=power, squares=squares)
        tried, circles = presses.take(chosen), fitted.circles[chosen]
        errors = depth_errors(fitted.calibration, tried, circles, finest=4)
        # The median: balls cut by the border are unreliable.
        wrong[power] = float(np.median([abs(math.log(error.radius)) for error in errors]))
        on_progress()
    return min(wrong, key=lambda power: wrong[power])


def depth_errors(
    calibration: SensorCalibration, presses: PressSet, circles: Circles, finest: int = 2
) -> list[DepthErrors]:
    """Return how the depth read at each press's circle (px) differs from its ball.

    `finest` is the `DepthEstimator`'s, px.
    """
    estimator = DepthEstimator(calibration, finest)
    return [
        sphere_in(estimator.estimate(image), calibration.pixel_pitch, circle, ball)
        for image, circle, ball in zip(presses.images, circles, presses.ball_radius, strict=True)
    ]


def median_background(presses: PressSet) -> Image:
    """Return the background as the presses show it away from their contacts.

    A gel settles under the first presses, which leaves bands of several counts. Where fewer than
    three presses are far away, the given background is changed as its surroundings are, so that no
    seam is left.
    """
    shape = presses.background.shape
    far = np.stack([squared_distance(shape, c) > (_FAR * c[2]) ** 2 for c in presses.circles])
    settled = presses.background.copy()
    enough = far.sum(0) >= 3
    for channel in range(3):
        masked = np.ma.MaskedArray(presses.images[..., channel], ~far)
        median = np.ma.median(masked, 0).filled(0)
        change = np.where(enough, median - presses.background[..., channel], 0)
        around = _spread(change.astype(np.float32), enough)
        filled = np.where(enough, median, presses.background[..., channel] + around)
        settled[..., channel] = np.round(filled).clip(0, 255)
    return settled


def _spread(change: Map, known: Bool[np.ndarray, "h w"]) -> Map:
    """Continue a change smoothly to unknown pixels: averages over ever wider windows."""
    spread, covered = np.zeros_like(change), np.zeros(change.shape, bool)
    weight = known.astype(np.float32)
    for sigma in _WINDOWS:
        total = cv2.GaussianBlur(change * weight, (0, 0), sigma)
        share = cv2.GaussianBlur(weight, (0, 0), sigma)
        new = (share > 0.05) & ~covered
        spread[new] = total[new] / share[new]
        covered |= new
    return cv2.GaussianBlur(spread, (0, 0), _WINDOWS[0])


def _noise(presses: PressSet) -> float:
    """Return the standard deviation (counts) of a pixel from one image to the next."""
    spreads = []
    for one, other in zip(presses.images[:-1], presses.images[1:], strict=True):
        change = (one.astype(np.float32) - other) / math.sqrt(2)
        fine = np.abs(change - cv2.GaussianBlur(change, (0, 0), 3))
        spreads.append(1.4826 * np.median(fine))  # robust against the contacts
    return float(np.mean(spreads))


def _with_limits(state: press_fit.FitState) -> SensorCalibration:
    """Set the model's limits to the steepest slope and the largest depth of the presses."""
    calibration, max_slope, max_depth = state.calibration, 0.0, 0.0
    for circle, ball in zip(state.circles, state.ball_radius, strict=True):
        surface = press_surface(calibration, circle, ball)
        nx, ny = shape_features(surface, calibration.pixel_pitch, math.inf, math.inf)[:2]
        max_slope = max(max_slope, float(np.hypot(nx, ny).max()))
        max_depth = max(max_depth, float(surface.max()))
    return replace(calibration, max_slope=max_slope, max_depth=max_depth)


def _label_line(labels: Circles, found: Circles) -> tuple[Circle, Circle]:
    """Return offset and slope of the line from labelled to fitted circles, per coordinate."""
    centred = labels - labels.mean(0)
    variance = (centred**2).mean(0)
    covariance = (centred * (found - found.mean(0))).mean(0)
    slope = np.where(variance > 1e-6, covariance / np.maximum(variance, 1e-6), 0.0)
    return found.mean(0) - slope * labels.mean(0), slope

"""Noise, drift, contact, markers, depth and force of one sensor, from its own frames."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.calibration.ball import Circle, find_circle
from touchgoal.control.calibration.held_out_depth import DepthErrors, sphere_in
from touchgoal.control.calibration.press_fit import move_circles
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.tactile.background import Background, Drift, local_change
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.force import estimate_force
from touchgoal.control.tactile.markers import Markers, MarkerTracker, without_markers
from touchgoal.control.tactile.picture_guard import (
    UNEXPLAINED,
    check_presses,
    check_untouched,
    explain,
    seam,
)
from touchgoal.control.tactile.sensor_calibration import SensorCalibration, load
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError

_PRESSES = 12  # presses that are read: the firmest frame of as many stretches of contact
_FIRM = 0.3  # of the strongest: a ball that only comes or goes has no depth to compare

Frame = UInt8[np.ndarray, "h w 3"]
FloatFrame = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class PressReading:
    """Depth, ball and force of one press.

    Attributes:
        frame: the picture.
        depth: of the gel, m.
        drawn: the simulator's picture of that depth, RGB.
        unexplained: share of the strongest tenth of the change that is not in that picture.
        circle: contact circle of the ball, px; None without a ball.
        ball: sphere in the depth map there; None without a ball.
        force: normal to the gel, N.
    """

    frame: Frame
    depth: Float32[np.ndarray, "h w"]
    drawn: Frame
    unexplained: float
    circle: Circle | None
    ball: DepthErrors | None
    force: float


@dataclass(frozen=True, eq=False)
class SensorCheck:
    """Findings of `check_sensor`.

    Attributes:
        frames, touching, torn: number of frames, of those in contact, and of those refused as torn.
        noise: standard deviation of a pixel from one untouched frame to the next, counts; None if
            no two in a row are untouched.
        drift, drift_from_file: of the light since the first frame, and against the sensor file.
        unlike_file: largest local change of the untouched gel against the sensor file, counts.
        threshold: contact strength from which a touch counts, counts.
        untouched, touched: largest strength of untouched frames; median of the presses, counts.
        markers: share of the dots that are found; None without markers.
        largest_shift: of a marker from its rest position, px.
        presses: firm ones that the sensor file explains.
        unexplained: number of firm ones that it does not explain.
        background: the untouched sensor at the end.
    """

    frames: int
    touching: int
    torn: int
    noise: float | None
    drift: Drift
    drift_from_file: Drift
    unlike_file: float
    threshold: float
    untouched: float
    touched: float
    markers: float | None
    largest_shift: float
    presses: list[PressReading]
    unexplained: int
    background: Frame


@dataclass(frozen=True, eq=False)
class _Touch:
    """A frame in contact, and the background at that time; dots painted over."""

    strength: float
    frame: Frame
    plain: Frame
    background: FloatFrame


def check_sensor(
    frames: Iterable[Frame], sensor: SensorModel, ball_radius: float | None = None
) -> SensorCheck:
    """Check the frames of one sensor, the first of them untouched.

    Args:
        frames: in order.
        sensor: its model, or its own file.
        ball_radius: m, if a ball presses.

    Raises:
        UserError: there are no frames, they are not this sensor's pictures (`picture_guard`), or
            they show no marker grid where one should be.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise UserError("no frames came: nothing to check")
    check_untouched(first, sensor, "the first frame")
    calibration = load(sensor.sensor_file)
    detector = ContactDetector(Background(first[None]))
    dots = _Dots(first, sensor)
    touches: list[_Touch] = []
    untouched, steps, torn = [0.0], [], 0
    before: Frame | None = first
    background = first.astype(np.float32)
    for frame in frames:
        if seam(frame):
            torn += 1
            continue
        dots.follow(frame)
        if detector.update(frame):
            background = detector.background.image.copy() if before is not None else background
            plain, rest = dots.painted(frame), dots.painted_at_rest(background)
            touches.append(_Touch(detector.strength, frame, plain, rest))
            before = None
            continue
        untouched.append(detector.strength)
        if before is not None:
            steps.append(_noise(before, frame))
        before = frame
    followed = detector.background
    drift = followed.drift()
    followed.reference = calibration.background.astype(np.float32)
    firm = _firmest(touches)
    plain = dots.painted_at_rest(np.rint(followed.image).astype(np.uint8))
    aligned = [_in_light(touch, plain) for touch in firm]
    check_presses(plain, aligned, sensor, "the frames in contact")
    readings = _read(firm, sensor, calibration, ball_radius)
    explained = [reading for reading in readings if reading.unexplained <= UNEXPLAINED]
    return SensorCheck(
        frames=len(untouched) + len(touches) + torn,
        touching=len(touches),
        torn=torn,
        noise=float(np.median(steps)) if steps else None,
        drift=drift,
        drift_from_file=followed.drift(),
        unlike_file=float(local_change(followed.image, followed.reference).max()),
        threshold=detector.threshold,
        untouched=max(untouched),
        touched=float(np.median([touch.strength for touch in firm])) if firm else 0.0,
        markers=dots.share_found,
        largest_shift=dots.largest_shift,
        presses=explained,
        unexplained=len(readings) - len(explained),
        background=np.rint(followed.image).astype(np.uint8),
    )


class _Dots:
    """Printed dots, followed and painted over; does nothing for a plain gel."""

    def __init__(self, first: Frame, sensor: SensorModel) -> None:
        grid, self._tracker, self._radius = sensor.markers, None, 0.0
        self._found: list[float] = [1.0]
        self.largest_shift = 0.0
        if grid is not None:
            self._tracker = MarkerTracker(first, grid, sensor.pixel_pitch)
            self._radius = self._tracker.rest.largest_radius(grid)

    @property
    def share_found(self) -> float | None:
        return None if self._tracker is None else float(np.mean(self._found))

    def follow(self, frame: Frame) -> None:
        if self._tracker is not None:
            self._found.append(float(self._tracker.update(frame).found.mean()))
            shift = np.linalg.norm(self._tracker.displacement, axis=-1).max()
            self.largest_shift = max(self.largest_shift, float(shift))

    def painted(self, image: np.ndarray) -> np.ndarray:
        return self._without(image, self._tracker and self._tracker.now)

    def painted_at_rest(self, image: np.ndarray) -> np.ndarray:
        return self._without(image, self._tracker and self._tracker.rest)

    def _without(self, image: np.ndarray, dots: Markers | None) -> np.ndarray:
        return image if dots is None else without_markers(image, dots.positions, self._radius)


def _read(
    touches: list[_Touch],
    sensor: SensorModel,
    calibration: SensorCalibration,
    ball_radius: float | None,
) -> list[PressReading]:
    estimator, pitch = DepthEstimator(calibration), sensor.pixel_pitch
    circles: list[Circle | None] = [None] * len(touches)
    if ball_radius is not None:
        circles = _contact_circles(touches, calibration, ball_radius)
    readings = []
    for touch, circle in zip(touches, circles, strict=True):
        read = explain(estimator, calibration, touch.plain, touch.background)
        ball = None
        if circle is not None and ball_radius is not None:
            ball = sphere_in(read.depth, pitch, circle, ball_radius)
        drawn = np.rint(touch.plain - read.left).clip(0, 255).astype(np.uint8)
        force = estimate_force(read.depth, pitch, sensor).normal
        readings.append(
            PressReading(touch.frame, read.depth, drawn, read.unexplained, circle, ball, force)
        )
    return readings


def _contact_circles(
    touches: list[_Touch], calibration: SensorCalibration, ball_radius: float
) -> list[Circle | None]:
    """Find each ball's contact circle and fit it as `calibrate` does; None if too faint."""
    background = calibration.background
    images, found, at = [], [], []
    for i, touch in enumerate(touches):
        image = _in_light(touch, background)
        try:
            found.append(find_circle(image, background))
        except UserError:
            continue
        images.append(image)
        at.append(i)
    circles: list[Circle | None] = [None] * len(touches)
    if at:
        balls, names = np.full(len(at), ball_radius), tuple(map(str, at))
        presses = PressSet(background, np.stack(images), np.stack(found), balls, names)
        for i, circle in zip(at, move_circles(calibration, presses), strict=True):
            circles[i] = circle
    return circles


def _in_light(touch: _Touch, background: Frame) -> Frame:
    """Return the touch as it would look on another untouched picture of its sensor."""
    change = touch.plain - touch.background  # float
    return np.rint(background + change).clip(0, 255).astype(np.uint8)


def _firmest(touches: list[_Touch]) -> list[_Touch]:
    """Return the strongest touch of each stretch, without those that hardly touch."""
    if not touches:
        return []
    parts = np.array_split(np.arange(len(touches)), min(_PRESSES, len(touches)))
    best = [max((touches[i] for i in part), key=lambda touch: touch.strength) for part in parts]
    least = _FIRM * max(touch.strength for touch in best)
    return [touch for touch in best if touch.strength >= least]


def _noise(before: Frame, frame: Frame) -> float:
    """Return the noise of a pixel, counts; the median change counts as drift."""
    change = frame.astype(np.float32) - before
    return float((change - np.median(change, (0, 1))).std() / np.sqrt(2))

"""Noise, drift, contact, markers, depth and force of one sensor, from its own frames."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice

import numpy as np

from touchgoal.control.arrays import Circle, Counts, Image, Map
from touchgoal.control.calibration.ball import DepthErrors, find_circle, sphere_in
from touchgoal.control.calibration.press_fit import move_circles
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.control.tactile import image_guard
from touchgoal.control.tactile.background import (
    SETTLES_WITHIN,
    Background,
    Drift,
    first_steady,
    local_change,
)
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.force import estimate_force
from touchgoal.control.tactile.markers.tracker import MarkerTracker, without_markers
from touchgoal.control.tactile.sensor_calibration import SensorCalibration, load
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError

_PRESSES = 12  # presses that are read: the firmest frame of as many stretches of contact
# share of the strongest: weaker ones, as a ball comes or goes, have no depth to compare
_FIRM = 0.3


@dataclass(frozen=True, eq=False)
class PressReading:
    """Depth, ball and force of one press."""

    frame: Image
    depth: Map  # of the gel, m
    drawn: Image  # the simulator's image of that depth, RGB
    unexplained: float  # share of the strongest tenth of the change that is not in that image
    # circle, ball: contact circle (px), and sphere in the depth map there; None without a ball
    circle: Circle | None
    ball: DepthErrors | None
    force: float  # normal to the gel, N


@dataclass(frozen=True, eq=False)
class SensorCheck:
    """Findings of `check_sensor`."""

    # frames, touching, torn: number of frames, of those in contact, and of those refused as torn
    frames: int
    touching: int
    torn: int
    # standard deviation of a pixel from one untouched frame to the next, counts; None if no two in
    # a row are untouched
    noise: float | None
    # drift, drift_from_file: of the light since the first frame, and against the sensor file
    drift: Drift
    drift_from_file: Drift
    unlike_file: float  # largest local change of the untouched gel against the sensor file, counts
    threshold: float  # contact strength from which a touch counts, counts
    # untouched, touched: largest strength of untouched frames; median of the presses, counts
    untouched: float
    touched: float
    markers: float | None  # share of the dots that are found; None without markers
    largest_shift_px: float  # of a marker from its rest position, px
    presses: list[PressReading]  # firm ones that the sensor file explains
    presses_unexplained: int  # number of firm ones that it does not explain
    images_only: str  # why depths and forces were not read; "" if they were
    background: Image  # the untouched sensor at the end


@dataclass(frozen=True, eq=False)
class _Touch:
    """A frame in contact, and the background at that time; dots painted over."""

    strength: float
    frame: Image
    plain: Image
    background: Counts


def check_sensor(
    frames: Iterable[Image], sensor: SensorModel, ball_radius: float | None = None
) -> SensorCheck:
    """Check the frames of one sensor in order, the first untouched; `ball_radius` (m) if known.

    UserError if there are no frames, they are not this sensor's (`image_guard`), or show no
    marker grid.
    """
    frames = iter(frames)
    start = list(islice(frames, SETTLES_WITHIN))
    if not start:
        raise UserError("no frames came: nothing to check")
    settled = first_steady(np.stack(start), "the sensor")
    first, frames = start[settled], chain(start[settled + 1 :], frames)
    image_guard.check_untouched(first, sensor, "the first frame")
    image_guard.check_unpressed(first, sensor, "the recording")
    calibration = load(sensor.sensor_file)
    detector = ContactDetector(Background(first[None]))
    dots = _Dots(first, sensor)
    touches: list[_Touch] = []
    untouched, steps, torn = [0.0], [], 0
    before: Image | None = first
    background = first.astype(np.float32)
    for frame in frames:
        if image_guard.find_seam(frame):
            torn += 1
            continue
        dots.follow(frame)
        touching = detector.update(frame)
        if touching:
            background = detector.background.image.copy() if before is not None else background
            plain, rest = dots.painted(frame), dots.painted(background, at_rest=True)
            touches.append(_Touch(detector.strength, frame, plain, rest))
            before = None
            continue
        untouched.append(detector.strength)
        if before is not None:
            steps.append(_noise(before, frame))
        before = frame
    followed = detector.background
    of_file = calibration.background.astype(np.float32)
    firm = _firmest(touches)
    untouched_now = np.rint(followed.image).astype(np.uint8)
    plain = dots.painted(untouched_now, at_rest=True)
    aligned = [_on_background(touch, plain) for touch in firm]
    image_guard.check_presses(plain, aligned, sensor, "the frames in contact")
    read = [] if sensor.images_only else firm
    readings = _read(read, sensor, calibration, ball_radius)
    explained = [reading for reading in readings if reading.unexplained <= image_guard.UNEXPLAINED]
    return SensorCheck(
        frames=len(untouched) + len(touches) + torn,
        touching=len(touches),
        torn=torn,
        noise=float(np.median(steps)) if steps else None,
        drift=followed.drift(),
        drift_from_file=followed.drift(of_file),
        unlike_file=float(local_change(followed.image, of_file).max()),
        threshold=detector.threshold,
        untouched=max(untouched),
        touched=float(np.median([touch.strength for touch in firm])) if firm else 0.0,
        markers=dots.share_found,
        largest_shift_px=dots.largest_shift,
        presses=explained,
        presses_unexplained=len(readings) - len(explained),
        images_only=sensor.images_only,
        background=untouched_now,
    )


class _Dots:
    """Printed dots, followed and painted over; does nothing for a plain gel."""

    def __init__(self, first: Image, sensor: SensorModel) -> None:
        grid, self._tracker, self._radius = sensor.markers, None, 0.0
        self._found: list[float] = [1.0]
        self.largest_shift = 0.0
        if grid is not None:
            self._tracker = MarkerTracker(first, grid, sensor.pixel_pitch)
            self._radius = self._tracker.rest.largest_radius(grid)

    @property
    def share_found(self) -> float | None:
        return None if self._tracker is None else float(np.mean(self._found))

    def follow(self, frame: Image) -> None:
        if self._tracker is not None:
            self._found.append(float(self._tracker.update(frame).found.mean()))
            shift = np.linalg.norm(self._tracker.displacement, axis=-1).max()
            self.largest_shift = max(self.largest_shift, float(shift))

    def painted(self, image: np.ndarray, at_rest: bool = False) -> np.ndarray:
        if self._tracker is None:
            return image
        dots = self._tracker.rest if at_rest else self._tracker.now
        return without_markers(image, dots.positions, self._radius)


def _read(
    touches: list[_Touch],
    sensor: SensorModel,
    calibration: SensorCalibration,
    ball_radius: float | None,
) -> list[PressReading]:
    estimator, pitch = DepthEstimator(calibration), sensor.pixel_pitch
    readings = []
    for touch in touches:
        read = image_guard.explain(estimator, touch.plain, touch.background)
        circle = ball = None
        if ball_radius is not None:
            with suppress(UserError):  # the ball is too faint
                circle = _contact_circle(touch, calibration, ball_radius)
                ball = sphere_in(read.depth, pitch, circle, ball_radius)
        drawn = np.rint(touch.plain - read.left).clip(0, 255).astype(np.uint8)
        force = estimate_force(read.depth, pitch, sensor)
        readings.append(
            PressReading(touch.frame, read.depth, drawn, read.unexplained, circle, ball, force)
        )
    return readings


def _contact_circle(touch: _Touch, calibration: SensorCalibration, ball_radius: float) -> Circle:
    """Find a ball's contact circle and fit it as `calibrate` does; UserError if it is too faint."""
    background = calibration.background
    image = _on_background(touch, background)
    found = find_circle(image, background)[None]
    press = PressSet(background, image[None], found, np.array([ball_radius]), ("",))
    return move_circles(calibration, press, found)[0]


def _on_background(touch: _Touch, background: Image) -> Image:
    """Return the touch's frame with its background exchanged for another one."""
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


def _noise(before: Image, frame: Image) -> float:
    """Return the noise of a pixel, counts; the median change counts as drift."""
    change = frame.astype(np.float32) - before
    return float((change - np.median(change, (0, 1))).std() / np.sqrt(2))

"""What one sensor's own frames say of it: noise, drift, contact, markers, depth and force."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.calibration.ball import Circle, find_circle
from touchgoal.control.calibration.held_out_depth import DepthErrors, sphere_in
from touchgoal.control.tactile.background import Background, Drift, local_change
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.force import estimate_force
from touchgoal.control.tactile.markers import Markers, MarkerTracker, without_markers
from touchgoal.control.tactile.sensor_calibration import load, shade
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError

_PRESSES = 12  # whose depth is read: the firmest frame of as many stretches of contact
_STRONGEST = 0.1  # share of the picture over which it is asked what the simulator explains
_FIRM = 0.3  # of the strongest: a ball that only comes or goes tells no depth

Frame = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class PressRead:
    """One press, read.

    Attributes:
        frame: the picture.
        depth: of the gel, m.
        drawn: the picture that the simulator makes of that depth, RGB.
        unexplained: share of the change, over its strongest tenth, that is not in that picture.
        circle: of the contact, px, if a ball pressed and is seen, and
        ball: the sphere that the depth shows there.
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
    """What the frames say.

    Attributes:
        frames, touching: how many, and in how many of them something touches.
        noise: standard deviation of a pixel from one untouched frame to the next, counts; None if
            no two in a row are untouched.
        drift, drift_from_file: of the light since the first frame, and against the sensor file.
        unlike_file: strongest spot by which the untouched gel differs from the sensor file's, counts.
        threshold: strength of contact (counts) from which on a touch is told, and
        untouched, touched: the strongest of the untouched frames', the median of the presses'.
        markers: share of the dots that are seen; None without markers.
        largest_shift: of a marker from its rest, px.
        presses: firm ones, read.
        background: the sensor untouched, at the end.
    """

    frames: int
    touching: int
    noise: float | None
    drift: Drift
    drift_from_file: Drift
    unlike_file: float
    threshold: float
    untouched: float
    touched: float
    markers: float | None
    largest_shift: float
    presses: list[PressRead]
    background: Frame


@dataclass(frozen=True, eq=False)
class _Touch:
    strength: float
    frame: Frame
    background: Float32[np.ndarray, "h w 3"]  # as it was then
    dots: Float32[np.ndarray, "rows columns 2"] | None


def check_sensor(
    frames: Iterable[Frame], sensor: SensorModel, ball_radius: float | None = None
) -> SensorCheck:
    """Go through the frames of one sensor, the first of them untouched.

    Args:
        frames: as they come.
        sensor: its model, or its own file.
        ball_radius: m, if a ball presses.

    Raises:
        UserError: there are none, or they show no marker grid where one should be.
    """
    reference = load(sensor.sensor_file).background
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise UserError("no frames came: nothing to check")
    detector = ContactDetector(Background(first[None]))
    tracker = MarkerTracker(first, sensor.markers, sensor.pixel_pitch) if sensor.markers else None
    touches: list[_Touch] = []
    untouched, steps, seen, shift = [0.0], [], [1.0], 0.0
    before: Frame | None = first
    background = first.astype(np.float32)
    for frame in frames:
        if tracker is not None:
            seen.append(float(tracker.update(frame).found.mean()))
            shift = max(shift, float(np.linalg.norm(tracker.displacement, axis=-1).max()))
        if detector.update(frame):
            dots = tracker.now.positions if tracker is not None else None
            background = detector.background.image.copy() if before is not None else background
            touches.append(_Touch(detector.strength, frame, background, dots))
            before = None
            continue
        untouched.append(detector.strength)
        if before is not None:
            steps.append(_noise(before, frame))
        before = frame
    followed = detector.background
    drift = followed.drift()
    followed.reference = reference.astype(np.float32)
    firm = _firmest(touches)
    read = _Reader(sensor, ball_radius, tracker.rest if tracker is not None else None)
    return SensorCheck(
        frames=len(untouched) + len(touches),
        touching=len(touches),
        noise=float(np.median(steps)) if steps else None,
        drift=drift,
        drift_from_file=followed.drift(),
        unlike_file=float(local_change(followed.image, followed.reference).max()),
        threshold=detector.threshold,
        untouched=max(untouched),
        touched=float(np.median([touch.strength for touch in firm])) if firm else 0.0,
        markers=float(np.mean(seen)) if tracker is not None else None,
        largest_shift=shift,
        presses=[read(touch) for touch in firm],
        background=np.rint(followed.image).astype(np.uint8),
    )


class _Reader:
    """Depth, ball and force of one touch."""

    def __init__(
        self,
        sensor: SensorModel,
        ball_radius: float | None,
        rest: Markers | None,
    ) -> None:
        self._sensor, self._ball_radius = sensor, ball_radius
        self._rest = rest.positions if rest is not None else None
        self._dot = rest.largest_radius(sensor.markers) if rest and sensor.markers else 0.0
        self._calibration = load(sensor.sensor_file)
        self._depth = DepthEstimator(self._calibration)

    def __call__(self, touch: _Touch) -> PressRead:
        frame, pitch = self._painted(touch.frame, touch.dots), self._sensor.pixel_pitch
        background = self._painted(touch.background, self._rest)
        depth = self._depth.estimate(frame, background)
        circle = ball = None
        if self._ball_radius is not None:
            try:
                circle = find_circle(frame, np.rint(background).astype(np.uint8))
                ball = sphere_in(depth, pitch, circle, self._ball_radius)
            except UserError:
                circle = None  # too faint: the picture shows it without
        force = estimate_force(depth, pitch, self._sensor).normal
        change, file = frame.astype(np.float32) - background, self._calibration.background
        left = change - (shade(self._calibration, depth) - file)
        drawn = np.rint(background + change - left).clip(0, 255).astype(np.uint8)
        strong = np.abs(change).sum(2)
        strong = strong >= np.quantile(strong, 1 - _STRONGEST)
        unexplained = float(np.abs(left[strong]).mean() / np.abs(change[strong]).mean())
        return PressRead(touch.frame, depth, drawn, unexplained, circle, ball, force)

    def _painted(self, image: np.ndarray, dots: np.ndarray | None) -> np.ndarray:
        return image if dots is None else without_markers(image, dots, self._dot)


def _firmest(touches: list[_Touch]) -> list[_Touch]:
    """The strongest of each stretch of the touches, without those that hardly touch."""
    if not touches:
        return []
    parts = np.array_split(np.arange(len(touches)), min(_PRESSES, len(touches)))
    best = [max((touches[i] for i in part), key=lambda touch: touch.strength) for part in parts]
    least = _FIRM * max(touch.strength for touch in best)
    return [touch for touch in best if touch.strength >= least]


def _noise(before: Frame, frame: Frame) -> float:
    """Of a pixel, counts, without what drifts: both frames lose their medians."""
    change = frame.astype(np.float32) - before
    return float((change - np.median(change, (0, 1))).std() / np.sqrt(2))

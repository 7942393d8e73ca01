"""The fastest way from rest to rest inside constant limits: speed up, cruise, slow down (S-curve)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Times = Float[np.ndarray, " k"]


@dataclass(frozen=True)
class SCurve:
    """Share of a path walked by time `t`: 0 before the start, 1 after `duration` (s).

    Speed rises along a ramp whose acceleration is a trapezoid, stays, and falls along another one.
    A trapezoid is the mean of a step over two windows, which is how a ramp is stored: (window of the
    acceleration, window of the jerk), both s.

    Attributes:
        speed: of the cruise, 1/s.
        rise, fall: the two ramps.
        falls_at: s at which the second ramp begins.
    """

    speed: float
    rise: tuple[float, float]
    fall: tuple[float, float]
    falls_at: float

    @property
    def duration(self) -> float:
        """From rest to rest, s."""
        return self.falls_at + sum(self.fall)

    @property
    def corners(self) -> Times:
        """Times (s) at which the jerk changes, and the moments before."""
        at = [
            begin + x
            for begin, (a, b) in ((0.0, self.rise), (self.falls_at, self.fall))
            for x in (0.0, a, b, a + b)
        ]
        return np.array([*at, *(np.array(at) - 1e-9)])

    def derivatives(self, t: Times) -> tuple[Times, Times, Times, Times]:
        """Share of the path and its first three derivatives at times `t` (s)."""
        rise, fall = _ramp(t, *self.rise), _ramp(t - self.falls_at, *self.fall)
        s, s1, s2, s3 = (self.speed * (up - down) for up, down in zip(rise, fall, strict=True))
        return s, s1, s2, s3

    def slowed(self, factor: float) -> "SCurve":
        """The same curve, `factor` times as long."""
        rise, fall = ((factor * a, factor * b) for a, b in (self.rise, self.fall))
        return SCurve(self.speed / factor, rise, fall, factor * self.falls_at)


def s_curve(speed: float, acceleration: float, deceleration: float, jerk: float) -> SCurve:
    """The fastest one inside these limits (of the share of the path, s)."""
    low, high = 0.0, speed
    if not _fits(speed, acceleration, deceleration, jerk):
        for _ in range(45):  # too short a way for the full speed: bisect for the highest
            middle = (low + high) / 2
            fits = _fits(middle, acceleration, deceleration, jerk)
            low, high = (middle, high) if fits else (low, middle)
        speed = low
    rise, fall = (_windows(speed, a, jerk) for a in (acceleration, deceleration))
    return SCurve(speed, rise, fall, 1 / speed + (sum(rise) - sum(fall)) / 2)


def _windows(speed: float, acceleration: float, jerk: float) -> tuple[float, float]:
    """The ramp from rest to `speed`; a low speed is reached before the full acceleration is."""
    acceleration = min(acceleration, np.sqrt(speed * jerk))
    return speed / acceleration, acceleration / jerk


def _fits(speed: float, acceleration: float, deceleration: float, jerk: float) -> bool:
    """Whether both ramps to `speed` together are no longer than the path."""
    ramps = (*_windows(speed, acceleration, jerk), *_windows(speed, deceleration, jerk))
    return bool(speed * sum(ramps) <= 2)


def _ramp(t: Times, a: float, b: float) -> tuple[Times, Times, Times, Times]:
    """Integral, value and two derivatives of a step at 0, averaged over windows of `a` and `b` s."""
    edges, signs = np.array([0.0, a, b, a + b]), np.array([1.0, -1.0, -1.0, 1.0])
    # Cut off behind the ramp: the powers of long times would cancel, with what is lost so.
    late = np.maximum(np.clip(t, 0, a + b)[..., None] - edges, 0)
    integral, value, slope = ((late**k @ signs) / (f * a * b) for k, f in ((3, 6), (2, 2), (1, 1)))
    bend = ((t[..., None] >= edges) @ signs) / (a * b)
    return integral + np.maximum(t - a - b, 0), value, slope, bend

"""The force on the hand as a real arm estimates it from joint torques, and its ceiling."""

import math
from functools import cache

import numpy as np
from jaxtyping import Float

_LAG = 0.02  # s, first order: the estimate's filter, as the twin's
_NOISE = np.array([0.1] * 3 + [0.01] * 3)  # N, Nm: standard deviation of each reading
_BIAS = np.array([1.5] * 3 + [0.3] * 3)  # N, Nm: largest of an episode
_DRIFT = np.array([0.5] * 3 + [0.1] * 3)  # N, Nm: standard deviation of the drift
_DRIFT_TIME = 1.0  # s

Wrench = Float[np.ndarray, "6"]


class WrenchError:
    """Noise, bias and drift of the estimate in one episode; guesses, not checked against an arm."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._bias = rng.uniform(-_BIAS, _BIAS)
        self._drift = rng.normal(0, _DRIFT)

    def update(self, seconds: float) -> None:
        """Advance the drift by `seconds`."""
        keep = _decay(seconds, _DRIFT_TIME)
        noise = _DRIFT * self._rng.standard_normal(6)
        self._drift = keep * self._drift + float(np.sqrt(1 - keep**2)) * noise

    def read(self) -> Wrench:
        """Draw the error of the next reading (N, Nm)."""
        return self._bias + self._drift + _NOISE * self._rng.standard_normal(6)


class EstimatedWrench:
    """The true wrench with the estimate's error and lag, for one episode."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._error = WrenchError(rng)
        self._filtered = np.zeros(6)

    def update(self, true: Wrench, seconds: float) -> None:
        """Take the true wrench (N, Nm), `seconds` after the last one."""
        self._filtered += (1 - _decay(seconds, _LAG)) * (true - self._filtered)
        self._error.update(seconds)

    def read(self) -> Wrench:
        """Return the estimate (N, Nm)."""
        return self._filtered + self._error.read()


class ForceMonitor:
    """The force on the hand, filtered as an arm filters it, against a ceiling."""

    def __init__(self, ceiling: float) -> None:
        """`ceiling`: N."""
        self._ceiling = ceiling
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        # exceeded: whether it has been above the ceiling in this episode
        self._filtered, self.exceeded = [0.0, 0.0, 0.0], False

    def update(self, force: Float[np.ndarray, "3"], seconds: float) -> None:
        """Take the true force (N), `seconds` after the last one."""
        share = 1 - _decay(seconds, _LAG)
        # Every 2 ms: on three numbers plain Python takes a fifth of NumPy's time.
        pairs = zip(self._filtered, force.tolist(), strict=True)
        self._filtered = [old + share * (new - old) for old, new in pairs]
        self.exceeded |= math.hypot(*self._filtered) > self._ceiling

    def check(self, wrench: Wrench) -> None:
        """Compare the force of a wrench with the ceiling (N)."""
        self.exceeded |= bool(np.linalg.norm(wrench[:3]) > self._ceiling)


@cache
def _decay(seconds: float, time_constant: float) -> float:
    return float(np.exp(-seconds / time_constant))

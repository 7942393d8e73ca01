"""The force on the hand as a real arm estimates it from its joint torques."""

from functools import cache

import numpy as np
from jaxtyping import Float

_LAG = 0.02  # s, first order: the estimate's filter, as the twin's
_NOISE = np.array([0.1] * 3 + [0.01] * 3)  # N, N m, standard deviation of each reading
_BIAS = np.array([1.5] * 3 + [0.3] * 3)  # N, N m, at most, of an episode
_WANDER = np.array([0.5] * 3 + [0.1] * 3)  # N, N m, standard deviation of what drifts
_WANDER_TIME = 1.0  # s

Wrench = Float[np.ndarray, "6"]


class WrenchError:
    """Noise, bias and drift of the estimate, drawn for one episode.

    The sizes are guesses: no data sheet and no recording of an arm was at hand to check them by.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._bias = rng.uniform(-_BIAS, _BIAS)
        self._wandering = rng.normal(0, _WANDER)

    def update(self, seconds: float) -> None:
        """So long after the last time."""
        keep, new = _wandering(seconds)
        noise = _WANDER * self._rng.standard_normal(6)
        self._wandering = keep * self._wandering + new * noise

    def read(self) -> Wrench:
        """By how much the next reading is wrong (N, N m)."""
        return self._bias + self._wandering + _NOISE * self._rng.standard_normal(6)


class EstimatedWrench:
    """The true wrench with the estimate's error and lag, for one episode."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._error = WrenchError(rng)
        self._filtered = np.zeros(6)

    def update(self, true: Wrench, seconds: float) -> None:
        """The true wrench (N, N m) so long after the last one."""
        self._filtered += (1 - np.exp(-seconds / _LAG)) * (true - self._filtered)
        self._error.update(seconds)

    def read(self) -> Wrench:
        """The estimate (N, N m)."""
        return self._filtered + self._error.read()


@cache
def _wandering(seconds: float) -> tuple[float, float]:
    """How much of what drifts is kept after a while, and how much is new."""
    keep = float(np.exp(-seconds / _WANDER_TIME))
    return keep, float(np.sqrt(1 - keep**2))

"""Speed of a twin's time against the wall clock, and its processor time."""

import time
from dataclasses import dataclass

import numpy as np

_BLOCK = 1000  # ms that are measured together


@dataclass(frozen=True)
class _Reading:
    wall: float
    twin: float
    pictures: float


class Pace:
    """Counts simulated seconds in which a client drives the arm.

    Attributes:
        ratios: simulated over wall time of each.
        twin, pictures: processor s of the twin's process and of its images' process.
    """

    def __init__(self) -> None:
        self.ratios: list[float] = []
        self.twin: list[float] = []
        self.pictures: list[float] = []
        self._began: _Reading | None = None
        self._steps = 0

    def count_step(self, driven: bool, pictures: float) -> None:
        """Count a millisecond.

        Args:
            driven: whether a client drives the arm.
            pictures: processor s that their process has taken so far.
        """
        if not driven:
            self._began = None
            return
        self._steps += 1
        if self._began is not None and self._steps < _BLOCK:
            return
        now = _Reading(time.monotonic(), time.process_time(), pictures)
        if self._began is not None:
            simulated = 1e-3 * _BLOCK
            self.ratios.append(simulated / (now.wall - self._began.wall))
            self.twin.append((now.twin - self._began.twin) / simulated)
            self.pictures.append((now.pictures - self._began.pictures) / simulated)
        self._began, self._steps = now, 0

    def summary(self) -> dict[str, float]:
        """Return figures of the counted seconds."""
        if not self.ratios:
            return {"seconds": 0}
        return {
            "seconds": len(self.ratios),
            "pace_median": float(np.median(self.ratios)),
            "pace_slowest": min(self.ratios),
            "processor_twin": float(np.median(self.twin)),
            "processor_pictures": float(np.median(self.pictures)),
        }

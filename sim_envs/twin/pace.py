"""Speed of a twin's time against the wall clock, and its processor time."""

import time

import numpy as np

_BLOCK = 1000  # ms that are measured together


class Pace:
    """Counts simulated seconds in which a client drives the arm."""

    def __init__(self) -> None:
        self._seconds: list[np.ndarray] = []  # s: wall, the twin's processor, its images' process
        self._began: np.ndarray | None = None
        self._steps = 0

    def count_step(self, driven: bool, images: float) -> None:
        """Count a millisecond; `images`: processor s that their process has taken so far."""
        if not driven:
            self._began = None
            return
        self._steps += 1
        if self._began is not None and self._steps < _BLOCK:
            return
        now = np.array([time.monotonic(), time.process_time(), images])
        if self._began is not None:
            self._seconds.append((now - self._began) / (1e-3 * _BLOCK))
        self._began, self._steps = now, 0

    def summary(self) -> dict[str, float]:
        """Return figures of the counted seconds."""
        if not self._seconds:
            return {"seconds": 0}
        wall, twin, images = np.transpose(self._seconds)
        return {
            "seconds": len(self._seconds),
            "pace_median": float(np.median(1 / wall)),
            "pace_slowest": float(1 / wall.max()),
            "processor_twin": float(np.median(twin)),
            "processor_pictures": float(np.median(images)),
        }

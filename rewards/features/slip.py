"""Slip on one fingertip: how far the contact's centre has moved on the gel since the grasp."""

import numpy as np
from jaxtyping import Float

_SETTLES = (
    0.4  # s of contact in which a grasp settles; validation objects: AUC of slips .93, without .91
)
_LOST = 0.4  # s without contact after which the grasp is over


class SlipMeter:
    """Measures frame after frame; a short loss of contact does not end the grasp."""

    def __init__(self, fps: float) -> None:
        """`fps`: frames per second."""
        self._fps = fps
        self._grasp: Float[np.ndarray, " 2"] | None = None  # centre where the grasp settled
        self._held = self._free = 0  # frames in contact since the grasp; without contact
        self._slip = 0.0

    def update(self, touching: bool, centre: tuple[float, float]) -> float:
        """Return the distance (m) of the contact's centre from where the grasp settled.

        During a short loss of contact it stays as it was; without a grasp it is 0.
        """
        if not touching:
            self._free += 1
            if self._free / self._fps > _LOST:
                self._grasp, self._held, self._slip = None, 0, 0.0
            return self._slip
        now = np.array(centre)
        if self._grasp is None or self._held / self._fps < _SETTLES:
            self._grasp = now
        self._held, self._free = self._held + 1, 0
        self._slip = float(np.linalg.norm(now - self._grasp))
        return self._slip

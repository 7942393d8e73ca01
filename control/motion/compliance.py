"""A hand that yields to what it presses on, by the measured force and torque."""

import numpy as np
from jaxtyping import Float

from touchgoal.control import features as ft
from touchgoal.control.features import Observation

_FREE_FORCE = 3.0  # N beyond the first reading that count as none: the weight of a carried object


class Compliance:
    """Velocity with which the hand gives way to forces beyond those at rest."""

    def __init__(self, force: float, torque: float, free_torque: float) -> None:
        """Take the speed per force, m/s per N, and per torque, rad/s per Nm.

        Torques up to `free_torque` (Nm) beyond the first reading count as none.
        """
        self._force, self._torque, self._free_torque = force, torque, free_torque

    def start(self, observation: Observation) -> None:
        """Take the wrench as that of the free hand."""
        self._at_rest = observation[ft.WRENCH].astype(np.float64)

    def velocity(self, observation: Observation) -> Float[np.ndarray, "6"]:
        """Return the hand's velocity, base frame (m/s, rad/s); none where the wrench is unknown."""
        force, torque = (observation[ft.WRENCH] - self._at_rest).reshape(2, 3)
        moved = self._force * _beyond(force, _FREE_FORCE)
        return np.concatenate([moved, self._torque * _beyond(torque, self._free_torque)])


def _beyond(vector: Float[np.ndarray, "3"], free: float) -> Float[np.ndarray, "3"]:
    """Return a vector shortened by `free`; NaN, as near an arm's singularity, counts as none."""
    length = float(np.linalg.norm(vector))
    return vector * (1 - free / length) if length > free else np.zeros(3)

"""A second try: a hand that closed on nothing, or lost its object, opens and goes back to where it began."""

from typing import Literal

import numpy as np
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.features import N_JOINTS, Observation
from touchgoal.control.safety.limits import FRANKA_HAND

_EMPTY = 0.004  # m: fingers that near to each other hold nothing
_CONFIRMING = 0.3  # s for which they must be, or for which a held object keeps the fingers apart
_STILL, _CLOSED_IN = 1e-3, 8e-3  # m by which a held object's width changes; a lost one's does
_SPEED = 0.6  # rad/s of the fastest joint on the way back
_BACK = 0.02  # rad from where the hand began: it is back
_TRIES = 2  # after the first


class Regrasp:
    """Follows the hand from plan to plan.

    Attributes:
        given_up: why there is no further try; "" before.
    """

    def __init__(self, hz: float, ticks: int) -> None:
        """Begin an episode; control ticks come at `hz`, and a plan after every so many."""
        self.given_up, self._hz, self._ticks = "", hz, ticks
        self._misses, self._goes_back = 0, False
        self._empty_ticks = self._held_ticks = 0
        self._width = 0.0  # m, at the last plan; of an object once it is held

    def next(
        self, observation: Observation, first: Observation, touches: bool, wanted: float | None
    ) -> Literal["act", "back", "look again"]:
        """Return what the next plan is for, if a fingertip touches or not, at the width last wanted (m)."""
        if self.given_up:
            return "back"
        joints, width = observation[ft.STATE][:N_JOINTS], observation[ft.STATE][-1]
        if self._goes_back:
            if np.abs(joints - first[ft.STATE][:N_JOINTS]).max() > _BACK:
                return "back"
            self._goes_back = False
            return "look again"
        if not self._is_empty(float(width), touches, wanted):
            return "act"
        self._empty_ticks, self._held_ticks = 0, 0
        self._misses, self._goes_back = self._misses + 1, True
        if self._misses > _TRIES:
            self.give_up("the object is not where the camera sees it, or slips away")
        return "back"

    def _is_empty(self, width: float, touches: bool, wanted: float | None) -> bool:
        """Return whether the fingers have met, or close in on what they held, or feel it no more."""
        needed = _CONFIRMING * self._hz
        self._empty_ticks = self._empty_ticks + self._ticks if width < _EMPTY else 0
        held, closing = self._held_ticks >= needed, wanted is not None and wanted < width - _STILL
        if held and closing and (not touches or width < self._width - _CLOSED_IN):
            return True
        still = closing and touches and abs(width - self._width) < _STILL
        if not held:
            self._held_ticks, self._width = (self._held_ticks + self._ticks) * still, width
        elif not closing:
            self._held_ticks = 0
        return self._empty_ticks >= needed

    def give_up(self, why: str) -> None:
        """End the tries."""
        self.given_up = f"the hand holds nothing ({self._misses} of {1 + _TRIES} tries): {why}"

    def way_back(
        self, observation: Observation, first: Observation, ticks: int
    ) -> Float32[np.ndarray, "t 8"]:
        """Return actions (`features.ACTION`) towards where the hand began; stand once given up."""
        left = first[ft.STATE][:N_JOINTS] - observation[ft.COMMAND][:N_JOINTS]
        if self.given_up:
            left = np.zeros_like(left)
        steps = max(1, int(np.ceil(np.abs(left).max() * self._hz / _SPEED)))
        moving = (np.arange(ticks) < steps)[:, None]
        actions = np.full((ticks, N_JOINTS + 1), FRANKA_HAND.stroke[1], np.float32)
        actions[:, :-1] = moving * left / steps
        return actions

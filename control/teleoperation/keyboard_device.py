"""Keyboard teleoperation: a typed key pushes or turns the hand for a moment."""

import numpy as np

from touchgoal.control.features import Observation
from touchgoal.control.teleoperation.device import GripperRequest, HandMotion, TeleoperationDevice

HELP = "w/s away/back  a/d left/right  r/f up/down  j/l yaw  i/k pitch  u/o roll  g grip  h let go"
# s for which a typed key counts as held. A terminal reports no releases; it repeats a held key after
# about 0.4 s, and of several held keys only the last.
_HOLD_SECONDS = 0.5
# One pair of keys for each axis, the positive direction first. Pitch is positive with the nose down.
_PAIRS = ("ws", "ad", "rf", "ou", "ki", "jl")
_AXES = {
    key: sign * axis
    for pair, axis in zip(_PAIRS, np.eye(6), strict=True)
    for key, sign in zip(pair, (1, -1), strict=True)
}
_GRIPPER: dict[str, GripperRequest] = {"g": "close", "h": "open"}


class KeyboardDevice(TeleoperationDevice):
    """Keys as full deflections; `hz` is the rate at which `read` is called."""

    def __init__(self, hz: float) -> None:
        self._hold_ticks = round(_HOLD_SECONDS * hz)
        self._held: dict[str, int] = {}  # ticks left
        self._gripper: GripperRequest = ""

    def press(self, keys: str) -> None:
        """Take typed keys, in this order; a key cancels its opposite, unknown ones are ignored."""
        for key in keys:
            self._gripper = _GRIPPER.get(key, self._gripper)
            if key in _AXES:
                pair = next(pair for pair in _PAIRS if key in pair)
                self._held.pop(pair.replace(key, ""), None)
                self._held[key] = self._hold_ticks

    def read(self, observation: Observation) -> HandMotion:
        """Return the sum of the keys that count as held."""
        twist = sum((_AXES[key] for key in self._held), np.zeros(6))
        self._held = {key: ticks - 1 for key, ticks in self._held.items() if ticks > 1}
        return HandMotion(twist, self._gripper)

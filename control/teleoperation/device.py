"""Teleoperation devices, the motion of the hand that a person asks for; the simplest is the keyboard.

A typed key pushes or turns the hand for a moment.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from touchgoal.control.features import Observation
from touchgoal.runtime.option_types import checked_dataclass

DeviceName = Literal["keyboard", "spacemouse", "scripted"]
GripperRequest = Literal["", "open", "close"]
Verdict = Literal["", "done", "not done"]


@checked_dataclass
class TeleoperationConfig:
    """Response of the hand to a device."""

    speed: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Speed of the hand at full deflection, m/s; with a keyboard, at any key."""
    turn_speed: Annotated[float, Field(gt=0, le=2)] = 0.6
    """Turning speed of the hand at full deflection, rad/s."""


@dataclass(frozen=True)
class HandMotion:
    """One tick's request; axes of the base frame: x away from the robot, y left, z up."""

    # motion along the axes, then turning about them, as shares of the full speeds in [-1, 1]
    twist: Float[np.ndarray, "6"]
    gripper: GripperRequest = ""  # empty: go on as before


class TeleoperationDevice(ABC):
    """A device that is read once a control tick."""

    verdict: Verdict = ""  #: how the device itself ends the episode; empty: a person does, by key

    def press(self, keys: str) -> None:  # noqa: B027  # most devices are not typed at
        """Take what was typed at the terminal, if the device is the keyboard."""

    @abstractmethod
    def read(self, observation: Observation) -> HandMotion:
        """Return the present request without waiting; DriverError if the device has gone."""

    def close(self) -> None:  # noqa: B027  # some hold nothing to release
        """Release the device, if there is one to release."""


KEYS = "w/s away/back  a/d left/right  r/f up/down  j/l yaw  i/k pitch  u/o roll  g grip  h let go"
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

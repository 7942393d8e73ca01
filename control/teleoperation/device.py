"""Base of teleoperation devices: the motion of the hand that a person asks for."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import Observation

DeviceName = Literal["keyboard", "spacemouse", "scripted"]
GripperRequest = Literal["", "open", "close"]
Verdict = Literal["", "done", "not done"]


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

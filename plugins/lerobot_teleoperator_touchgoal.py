"""A hand led by a SpaceMouse or by keys in lerobot: `--teleop.type=touchgoal`, with `--robot.actions=hand`.

The robot yields to what the hand presses on, as in `touchgoal record-demos`.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from touchgoal.control import features as ft
from touchgoal.control.deployment.terminal import Terminal
from touchgoal.control.teleoperation.device import (
    KEYS,
    HandMotion,
    KeyboardDevice,
    TeleoperationDevice,
)
from touchgoal.control.teleoperation.spacemouse import SpaceMouse

MOTION = *(f"hand.{axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw")), "gripper.open"
"""Motion along and turning about the base's axes (x away from the robot, y left, z up), as shares of the full
speed in [-1, 1]; 1 to open the gripper, 0 to close it."""


@TeleoperatorConfig.register_subclass("touchgoal")
@dataclass(kw_only=True)
class TouchgoalTeleoperatorConfig(TeleoperatorConfig):
    """Options of the device."""

    device: Literal["spacemouse", "keyboard"] = "spacemouse"
    """What leads the hand; the keyboard is that of the terminal."""


class TouchgoalTeleoperator(Teleoperator):
    """Motions of the hand, read once a tick; the gripper starts open."""

    config_class, name = TouchgoalTeleoperatorConfig, "touchgoal"
    action_features = property(lambda self: dict.fromkeys(MOTION, float))
    feedback_features = property(lambda self: {})
    is_connected = property(lambda self: self._device is not None)
    is_calibrated = True

    def __init__(self, config: TouchgoalTeleoperatorConfig) -> None:
        super().__init__(config)
        self._name = config.device
        self._device: TeleoperationDevice | None = None

    def calibrate(self) -> None:
        """Do nothing: the devices need none."""

    configure = calibrate

    def connect(self, calibrate: bool = True) -> None:
        """Open the device; UserError if there is none."""
        self._open, self._terminal = 1.0, None
        if self._name == "spacemouse":
            self._device = SpaceMouse()
            return
        self._device = KeyboardDevice(ft.CONTROL_HZ)
        self._terminal = Terminal(self._device.press)
        self._watched = self._terminal.watching()
        self._watched.__enter__()
        print(KEYS, flush=True)

    def get_action(self) -> dict[str, Any]:
        """Return what the device asks for now; KeyboardInterrupt for space or Ctrl-C, DriverError if it has gone."""
        if self._terminal is not None and self._terminal.operator_request() == "stop":
            raise KeyboardInterrupt
        asked = self._device.read({})
        self._open = {"open": 1.0, "close": 0.0}.get(asked.gripper, self._open)
        return dict(zip(MOTION, [*asked.twist.tolist(), self._open], strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: the devices feel nothing."""

    def disconnect(self) -> None:
        """Release the device and the terminal."""
        if self._terminal is not None:
            self._watched.__exit__(None, None, None)
        if self._device is not None:
            self._device.close()
        self._device = self._terminal = None


class AskedMotion(TeleoperationDevice):
    """The newest action of lerobot's as a device of touchgoal's."""

    def __init__(self) -> None:
        self._motion = HandMotion(np.zeros(6))

    def ask(self, action: dict[str, Any]) -> dict[str, float]:
        """Take an action by `MOTION`; return it within its bounds."""
        *twist, opened = np.clip([float(action[name]) for name in MOTION], -1, 1)
        self._motion = HandMotion(np.array(twist), "open" if opened > 0.5 else "close")
        return dict(zip(MOTION, [*twist, max(opened, 0.0)], strict=True))

    def read(self, observation: ft.Observation) -> HandMotion:
        """Return the motion asked for last."""
        return self._motion

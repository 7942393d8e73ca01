"""A 3Dconnexion SpaceMouse by Linux's hidraw interface.

Its reports, little-endian 16-bit counts, are documented by PySpaceMouse's table of devices
(github.com/JakubAndrysek/PySpaceMouse, `devices.toml`):

| report | bytes 1 to 6 | bytes 7 to 12 |
|---|---|---|
| 1 | translation x, y, z | rotation about x, y, z, on wireless devices |
| 2 | rotation about x, y, z, on the others | |
| 3 | buttons, a bit each, from the lowest bit of byte 1 | |

The device's axes: x right, y towards the user, z down.
"""

import os
import struct
import time
from pathlib import Path

import numpy as np

from touchgoal.control.features import Observation
from touchgoal.control.interfaces import DriverError
from touchgoal.control.teleoperation.device import GripperRequest, HandMotion, TeleoperationDevice
from touchgoal.runtime.errors import UserError

_ROOT = Path("/sys/class/hidraw")
_MAKERS = (0x256F, 0x046D)  # USB vendors: 3Dconnexion, and Logitech for those before 2013
_LOGITECH_PRODUCTS = range(0xC621, 0xC62C)  # Logitech's 3D mice: 0xC625 to 0xC62B are in use
_FULL_SCALE = 350.0  # counts at full deflection (`axis_scale` of the table)
_DEAD_ZONE = 0.06  # share of full deflection; a cap at rest may be off by some counts
_SILENCE = 0.5  # s without a report after which the cap counts as released
_LONGEST = 64  # bytes of a report over USB full speed
# From the device's axes to the base's, for a user who looks the way the robot does.
_TO_BASE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class SpaceMouse(TeleoperationDevice):
    """The cap moves and turns the hand; the left button closes it, the right one opens it."""

    def __init__(self, root: Path = _ROOT, devices: Path = Path("/dev")) -> None:
        """Open the SpaceMouse that is plugged in; UserError if there is none or it is unreadable."""
        path = devices / find_spacemouse(root)
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise UserError(
                f"cannot read the SpaceMouse {path} ({error.strerror}): allow it by a udev rule, "
                'KERNEL=="hidraw*", ATTRS{idVendor}=="256f", MODE="0666", and plug it in again'
            ) from error
        self._counts = np.zeros(6)  # translation, rotation, the device's axes
        self._gripper: GripperRequest = ""
        self._heard = 0.0  # monotonic s of the last report

    def read(self, observation: Observation) -> HandMotion:
        """Return the newest deflection; DriverError if it was unplugged."""
        try:
            while report := os.read(self._file, _LONGEST):
                self.take(report)
                self._heard = time.monotonic()
        except BlockingIOError:
            pass
        except OSError as error:
            raise DriverError(f"the SpaceMouse has gone ({error.strerror}): plug it in") from error
        if time.monotonic() - self._heard > _SILENCE:
            self._counts[:] = 0.0
        share = np.clip(self._counts / _FULL_SCALE, -1.0, 1.0)
        share[np.abs(share) < _DEAD_ZONE] = 0.0
        return HandMotion((share.reshape(2, 3) @ _TO_BASE.T).ravel(), self._gripper)

    def take(self, report: bytes) -> None:
        """Take one report; only those of motion and buttons count."""
        kind, values = report[0], report[1:]
        if kind == 1 and len(values) >= 12:
            self._counts[:] = struct.unpack("<6h", values[:12])
        elif kind in (1, 2) and len(values) >= 6:
            self._counts[3 * (kind - 1) : 3 * kind] = struct.unpack("<3h", values[:6])
        elif kind == 3 and len(values) >= 1 and values[0] & 3:
            self._gripper = "close" if values[0] & 1 else "open"

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


def find_spacemouse(root: Path = _ROOT) -> str:
    """Return the name of the first SpaceMouse's hidraw device; UserError if there is none."""
    for node in sorted(root.glob("hidraw*"), key=lambda n: (len(n.name), n.name)):
        # such as HID_ID=0003:0000256F:0000C635: bus, vendor, product
        for line in (node / "device" / "uevent").read_text().splitlines():
            if not line.startswith("HID_ID="):
                continue
            _, vendor, product = (int(part, 16) for part in line[7:].split(":"))
            logitech = vendor == _MAKERS[1] and product in _LOGITECH_PRODUCTS
            if vendor == _MAKERS[0] or logitech:
                return node.name
    raise UserError(
        "no SpaceMouse is plugged in (none in /sys/class/hidraw): plug it in, or --device keyboard"
    )

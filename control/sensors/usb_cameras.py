"""USB cameras by product name and serial number in Linux's device tree.

Indices of `/dev/video*` change from boot to boot, and two fingertips look alike; a serial number
does not change.
"""

from dataclasses import dataclass
from pathlib import Path

from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError

_ROOT = Path("/sys/class/video4linux")
_PRODUCTS = {  # in USB product names, as gsrobotics and digit-interface look for them
    "gelsight_mini": "GelSight Mini",
    "gelsight_mini_markers": "GelSight Mini",
    "digit": "DIGIT",
}


@dataclass(frozen=True)
class UsbCamera:
    """Camera that is plugged in: device such as /dev/video2, product name, serial number."""

    device: str
    product: str
    serial: str


def list_cameras(root: Path = _ROOT) -> list[UsbCamera]:
    """List all USB cameras, each by its node with images (index 0)."""
    found = []
    for node in sorted(root.glob("video*"), key=lambda n: (len(n.name), n.name)):
        if _read_text(node / "index") != "0":
            continue
        device = (node / "device").resolve()  # the USB device is one of its parent folders
        usb = next((p for p in (device, *device.parents) if (p / "idProduct").exists()), node)
        serial, product = _read_text(usb / "serial"), _read_text(usb / "product")
        found.append(UsbCamera(f"/dev/{node.name}", product or _read_text(node / "name"), serial))
    return found


def find_sensor_camera(model: SensorModel, serial: str = "", root: Path = _ROOT) -> UsbCamera:
    """Return the camera of a fingertip sensor, with this serial number if one is given.

    UserError if there is none, there are several, or this kind's USB name is not known.
    """
    if model.name not in _PRODUCTS:
        raise UserError(f"a {model.name} has no USB name known here: give its device instead")
    product, cameras = _PRODUCTS[model.name], list_cameras(root)
    found = [c for c in cameras if product in c.product and serial in ("", c.serial)]
    if len(found) == 1:
        return found[0]
    wanted = f"{product} with serial number {serial}" if serial else product
    if found:
        choice = ", ".join(c.serial or "none" for c in found)
        raise UserError(
            f"{len(found)} cameras are a {wanted}: say which, by serial number: {choice}"
        )
    present = ", ".join(f"{c.product} ({c.serial})" for c in cameras) or "none"
    raise UserError(f"no {wanted} is plugged in; cameras found: {present}")


def _read_text(path: Path) -> str:
    return path.read_text(errors="replace").strip() if path.exists() else ""

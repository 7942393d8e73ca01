"""Frames of one fingertip sensor: plugged in, streamed, or recorded.

A plugged-in one is found by its product's name and its serial number in Linux's device tree: indices of
`/dev/video*` change from boot to boot, and two fingertips look alike.
"""

import math
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path

from touchgoal.control.arrays import Image
from touchgoal.control.interfaces import DriverError
from touchgoal.control.sensors import tactile_camera
from touchgoal.control.sensors.clip import open_clip
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Corners

_POLL_INTERVAL = 0.005  # s between looks for a new frame
_TIMEOUT = 5.0  # s without a new frame after which the sensor counts as lost


def is_recorded(source: str) -> bool:
    """Return whether a source is a video file or a folder of images."""
    return not source.startswith("/dev/") and Path(source).exists()


def open_frames(
    source: str,
    model: SensorModel,
    corners: Corners | None = None,
    exposure: float | None = None,
    white_balance: int | None = None,
    seconds: float = math.inf,
) -> Generator[Image, None, None]:
    """Yield the frames of a recording, or of a live sensor for some seconds or until Ctrl-C.

    The source is one of `fingertip_video`, or a video file or a folder of images; exposure and
    white balance are locked on a live camera (`VideoConfig`). UserError or DriverError if the
    source cannot be read, or a live sensor sent nothing for 5 s.
    """
    if is_recorded(source):
        yield from recorded_frames(Path(source), model, corners)
        return
    video = fingertip_video(source, model)
    locked = replace(video, exposure=exposure, white_balance=white_balance)
    view = tactile_camera.fingertip_view(model, source, corners=corners)
    camera = tactile_camera.TactileCamera(VideoCamera(locked), model, view)
    last, heard = -1, time.monotonic()
    end = heard + seconds
    try:
        while time.monotonic() < end:
            frame = camera.read()
            if frame.sequence != last:
                last, heard = frame.sequence, time.monotonic()
                yield frame.image
            elif time.monotonic() > heard + _TIMEOUT:
                raise DriverError(f"{source}: {camera.problem or 'no more images'}")
            time.sleep(_POLL_INTERVAL)
    except KeyboardInterrupt:
        print("ended")
    finally:
        camera.close()


def fingertip_video(source: str, model: SensorModel) -> VideoConfig:
    """Describe a live source: a USB serial number, a device (/dev/video2) or a stream's address.

    A serial number is looked up at each opening: its device changes when it is plugged in again.
    """
    device = None if "/" in source else lambda: find_sensor_camera(model, source).device
    return VideoConfig(source, rate=model.frame_rate, device=device)


def recorded_frames(
    source: Path, model: SensorModel, corners: Corners | None = None
) -> Generator[Image, None, None]:
    """Yield the frames of a video, or of a folder's images by name (background.png first).

    Without corners of the gel the images count as already cut. UserError if there are none, or
    they have other proportions than the sensor's.
    """
    view = tactile_camera.Crop(corners=corners)
    for frame in open_clip(source).frames():
        yield tactile_camera.crop_to_sensor(frame, model, view)


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

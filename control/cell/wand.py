"""A real touch wand: a gel with a load cell and a camera on a stick, three cameras over the bench."""

import time
from contextlib import ExitStack, closing
from dataclasses import dataclass as plain_dataclass
from dataclasses import field, replace
from typing import Annotated

import numpy as np
from jaxtyping import UInt8
from pydantic import Field
from pydantic.dataclasses import dataclass

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image
from touchgoal.control.cell.config import CameraSection, Exposure, Kelvin, Pixels
from touchgoal.control.deployment.observation import crop_and_resize
from touchgoal.control.interfaces import Camera, LoadCell, TactileSensor
from touchgoal.control.sensors.fingertip_source import fingertip_video
from touchgoal.control.sensors.load_cell import LoadCellConfig, SerialLoadCell
from touchgoal.control.sensors.tactile_camera import TactileCamera, fingertip_view
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.control.wand_touch import VIEW_SHAPE
from touchgoal.runtime.option_types import STRICT, Corners

_SILENT = 0.5  # s without news of a device that mean a problem


@dataclass(frozen=True, config=STRICT)
class GelSection:
    """The tactile sensor on the wand."""

    source: str
    """USB serial number, device (/dev/video2), or address of a stream."""
    sensor: str = "gelsight_mini"
    """Model of the sensor (touchgoal list sensors), or the folder that calibrate wrote for it."""
    size: tuple[Pixels, Pixels] | None = None
    """Width and height to ask the sensor's camera for, pixels; default: its default."""
    border: Annotated[float, Field(ge=0, lt=0.5)] | None = None
    """Share cut off at each side of the camera's image; default: the model's."""
    corners: Corners | None = None
    """Corners of the gel in the camera's image, px, for a camera at an angle (gelsight_wedge)."""
    exposure: Exposure | None = None
    """Exposure to lock, in the camera's units (v4l2-ctl --list-ctrls); default: as it is set."""
    white_balance: Kelvin | None = None
    """White balance to lock, K; default: as it is set."""


@dataclass(frozen=True, config=STRICT)
class ViewsSection:
    """The four cameras."""

    top: CameraSection
    """Camera above the bench."""
    side_left: CameraSection
    """Camera at the left of the bench."""
    side_right: CameraSection
    """Camera at the right of the bench."""
    wand: CameraSection
    """Camera on the wand."""


@dataclass(frozen=True, config=STRICT)
class WandConfig:
    """Everything `collect-touches --wand` needs to know."""

    gel: GelSection
    """The tactile sensor on the wand."""
    cameras: ViewsSection
    """The four cameras: top, side_left, side_right, wand."""
    load_cell: LoadCellConfig
    """The load cell behind the gel; pressing must read positive."""


@plain_dataclass(frozen=True, eq=False)
class WandReading:
    """One reading of all devices: RGB image of the gel, view -> RGB, force of the load cell (N)."""

    image: Image
    views: dict[str, UInt8[np.ndarray, "H W 3"]]
    force: float


@plain_dataclass(eq=False)
class Wand:
    """A wand's connected devices; views are cut to the middle square and scaled to 224 px."""

    gel: TactileSensor
    cameras: dict[str, Camera]
    load_cell: LoadCell
    _last: int = field(default=-1, init=False)

    def read(self) -> WandReading | None:
        """Return the readings, or None until the gel's next image; DriverError as the devices."""
        frame = self.gel.read()
        if frame.sequence == self._last:
            return None
        self._last = frame.sequence
        views = {
            name: crop_and_resize(camera.read().image, VIEW_SHAPE)
            for name, camera in self.cameras.items()
        }
        return WandReading(frame.image, views, self.load_cell.read().force)

    def problem(self) -> str:
        """Say which device has sent nothing new for half a second; "" if none."""
        for name, device in {"gel": self.gel, **self.cameras, "load cell": self.load_cell}.items():
            age = time.monotonic() - device.read().stamp
            if age > _SILENT:
                known = "" if device is self.load_cell else device.problem
                return f"{name}: {known or f'nothing new for {age:.1f} s: check its cable'}"
        return ""

    def close(self) -> None:
        """Release all devices."""
        for device in (self.gel, *self.cameras.values(), self.load_cell):
            device.close()


def connect_wand(config: WandConfig) -> Wand:
    """Connect to all devices; UserError or DriverError if one is missing or silent."""
    with ExitStack() as undo:
        cameras: dict[str, Camera] = {}
        for name in (key.removeprefix(ft.IMAGE_PREFIX) for key in ft.WAND_VIEWS):
            own: CameraSection = getattr(config.cameras, name)
            video = VideoConfig(own.source, own.size, own.rate, own.exposure, own.white_balance)
            cameras[name] = undo.enter_context(closing(VideoCamera(video)))
        gel = undo.enter_context(closing(_open_gel(config.gel)))
        load_cell = undo.enter_context(closing(SerialLoadCell(config.load_cell)))
        wand = Wand(gel, cameras, load_cell)
        wand.read()  # raises now if a device is silent
        undo.pop_all()
    return wand


def _open_gel(own: GelSection) -> TactileCamera:
    model = find_sensor(own.sensor)
    video = fingertip_video(own.source, model)
    locked = replace(video, size=own.size, exposure=own.exposure, white_balance=own.white_balance)
    view = fingertip_view(model, own.source, own.border, own.corners)
    return TactileCamera(VideoCamera(locked), model, view)

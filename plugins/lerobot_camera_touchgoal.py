"""A cell's cameras in lerobot: `--robot.cameras='{tip: {type: touchgoal, cell: …, camera: …}}'`."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path

from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image
from touchgoal.control.cell.cell_file import find_cell_file, read_cell_file
from touchgoal.control.cell.connection import camera_formats, connect_camera
from touchgoal.control.deployment.observation import crop_and_resize
from touchgoal.control.interfaces import Frame
from touchgoal.control.sensors.fingertip_source import list_cameras
from touchgoal.runtime.errors import UserError

_TIMEOUT_MS = 10_000.0  # for the next image, as lerobot's own cameras


@CameraConfig.register_subclass("touchgoal")
@dataclass(kw_only=True)
class TouchgoalCameraConfig(CameraConfig):
    """Options of a camera; its rate and size are those that touchgoal records."""

    cell: str
    """Cell file, or the cell.json of a twin in real time."""
    camera: str
    """tactile_left, tactile_right, front or wrist."""

    def __post_init__(self) -> None:
        cell = read_cell_file(find_cell_file(Path(self.cell)))
        if cell.lock_step:
            raise UserError("a twin in lock-step sends images to its arm alone: start it without")
        offered = {k.removeprefix(ft.IMAGE_PREFIX): f for k, f in camera_formats(cell).items()}
        if self.camera not in offered:
            raise UserError(f"{self.cell} has no camera {self.camera}: name one of {[*offered]}")
        for name, own in zip(("fps", "height", "width"), offered[self.camera], strict=True):
            if getattr(self, name) not in (None, round(own)):
                raise UserError(f"{name} of {self.camera} is {own} in {self.cell}: leave it out")
            setattr(self, name, round(own))


class TouchgoalCamera(Camera):
    """Source of RGB images as touchgoal records them; TimeoutError if none is fresh by its cell file."""

    def __init__(self, config: TouchgoalCameraConfig) -> None:
        super().__init__(config)
        self._cell = read_cell_file(find_cell_file(Path(config.cell)))
        self._key, self._camera, self._last = ft.IMAGE_PREFIX + config.camera, None, -1

    is_connected = property(lambda self: self._camera is not None)

    @staticmethod
    def find_cameras() -> list[dict[str, str]]:
        """Return device, product and serial number of USB cameras, for a cell file."""
        return [asdict(camera) for camera in list_cameras()]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Open the camera; UserError if it is missing."""
        self._camera = connect_camera(self._cell, self._key)
        if warmup:
            self._fresh(_TIMEOUT_MS)

    def read(self) -> Image:
        """Wait for the next image."""
        self._last = self._fresh(_TIMEOUT_MS).sequence
        return self.async_read(_TIMEOUT_MS)

    def async_read(self, timeout_ms: float = 200) -> Image:
        """Return the newest image that was not read yet; wait for one if need be."""
        frame = self._fresh(timeout_ms, known=self._last)
        self._last = frame.sequence
        return crop_and_resize(frame.image, (self.height, self.width))

    def read_latest(self, max_age_ms: float = 500) -> Image:
        """Return the newest image at once."""
        return crop_and_resize(self._fresh(0.0, max_age_ms).image, (self.height, self.width))

    @check_if_not_connected
    def _fresh(self, timeout_ms: float, max_age_ms: float = _TIMEOUT_MS, known: int = -1) -> Frame:
        end = time.monotonic() + timeout_ms / 1e3
        max_age = min(max_age_ms / 1e3, self._cell.safety.observation_age)
        while True:
            frame = self._camera.read()
            age = time.monotonic() - frame.stamp
            if age <= max_age and frame.sequence != known:
                return frame
            if time.monotonic() >= end:
                raise TimeoutError(self._camera.problem or f"{self._key} is {age:.2f} s old")
            time.sleep(0.002)

    def disconnect(self) -> None:
        """Release the camera."""
        if self._camera is not None:
            self._camera.close()
        self._camera = None

"""Frames of one fingertip sensor: plugged in, streamed, or recorded."""

import math
import time
from collections.abc import Generator
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control.interfaces import DriverError
from touchgoal.control.sensors.tactile_camera import (
    DIGIT_CROP,
    GELSIGHT_MINI_CROP,
    NO_CROP,
    Crop,
    TactileCamera,
    crop_to_sensor,
)
from touchgoal.control.sensors.usb_cameras import find_sensor_camera
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_models import DIGIT, GELSIGHT_WEDGE, SensorModel
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Corners
from touchgoal.runtime.picture_file import read_picture

_PICTURES = (".png", ".jpg", ".jpeg")
_UNTOUCHED = "background.png"  # of a folder of presses: what the sensor shows before them
_POLL_INTERVAL = 0.005  # s between looks for a new frame
_TIMEOUT = 5.0  # s without any

Frame = UInt8[np.ndarray, "h w 3"]


def is_recorded(source: str) -> bool:
    """Return whether a source is a video file or a folder of pictures."""
    return not source.startswith("/dev/") and Path(source).exists()


def open_frames(
    source: str,
    model: SensorModel,
    corners: Corners | None = None,
    exposure: float | None = None,
    white_balance: int | None = None,
    seconds: float = math.inf,
) -> Generator[Frame, None, None]:
    """Yield the frames of a recording, or of a live sensor for some time or until Ctrl-C.

    Args:
        source: see `fingertip_video`, or a video file or a folder of pictures.
        model: of the sensor.
        corners: of the gel, px, if the camera sees it at an angle.
        exposure, white_balance: to lock on a live camera (`VideoConfig`).
        seconds: after which a live sensor is closed.

    Raises:
        UserError: the source cannot be read.
        DriverError: a live sensor sent nothing for 5 s.
    """
    if is_recorded(source):
        yield from recorded_frames(Path(source), model, corners)
        return
    video = fingertip_video(source, model, corners)
    locked = replace(video, exposure=exposure, white_balance=white_balance)
    end = time.monotonic() + seconds
    try:
        for frame in live_frames(locked, model, corners):
            yield frame
            if time.monotonic() > end:
                return
    except KeyboardInterrupt:
        print("ended")


def fingertip_video(source: str, model: SensorModel, corners: Corners | None = None) -> VideoConfig:
    """Describe a live source: a USB serial number, a device (/dev/video2) or a stream's address.

    A serial number is looked up at each opening, because its device changes when it is plugged in
    again.
    """
    return VideoConfig(
        source,
        rate=model.frame_rate,
        gel=True,
        dots=_dots(model, fingertip_view(model, source, corners=corners)),
        device=None if "/" in source else partial(_device_of, model, source),
    )


def fingertip_view(
    model: SensorModel, source: str, border: float | None = None, corners: Corners | None = None
) -> Crop:
    """Return the crop of a source; a stream without corners is already cut and turned.

    Raises:
        UserError: the camera sees the gel at an angle and the corners are missing.
    """
    if corners is not None:
        return Crop(corners=corners)
    if model.name == GELSIGHT_WEDGE.name and "://" not in source:
        raise UserError(
            f"the camera of a {model.name} sees its gel at an angle: give the corners of the gel "
            "in its picture"
        )
    if "://" in source:
        view = NO_CROP
    else:
        view = DIGIT_CROP if model.name == DIGIT.name else GELSIGHT_MINI_CROP
    return view if border is None else replace(view, border=border)


def recorded_frames(
    source: Path, model: SensorModel, corners: Corners | None = None
) -> Generator[Frame, None, None]:
    """Yield the frames of a video, or of a folder's pictures by name (background.png first).

    Without corners of the gel the pictures count as already cut.

    Raises:
        UserError: there are no pictures, or they have other proportions than the sensor's.
    """
    empty, view = True, Crop(corners=corners)
    for frame in _folder(source) if source.is_dir() else _video(source):
        empty = False
        yield crop_to_sensor(frame, model, view)
    if empty:
        raise UserError(
            f"{source} holds no pictures: give a video, or a folder of PNG or JPEG files"
        )


def live_frames(
    config: VideoConfig, model: SensorModel, corners: Corners | None = None
) -> Generator[Frame, None, None]:
    """Yield frames of a live sensor without end; close the iterator to release it.

    Raises:
        UserError: the source cannot be opened.
        DriverError: no frame came for 5 s.
    """
    view = fingertip_view(model, config.source, corners=corners)
    camera = TactileCamera(VideoCamera(config), model, view)
    try:
        last, heard = -1, time.monotonic()
        while True:
            frame = camera.read()
            if frame.sequence != last:
                last, heard = frame.sequence, time.monotonic()
                yield frame.image
            elif time.monotonic() > heard + _TIMEOUT:
                raise DriverError(f"{config.source}: {camera.problem or 'no more pictures'}")
            time.sleep(_POLL_INTERVAL)
    finally:
        camera.close()


def _dots(model: SensorModel, view: Crop) -> float:
    """Return the diameter of printed dots over the camera picture's diagonal; 0 without."""
    if model.markers is None:
        return 0.0
    diagonal = model.pixel_pitch * float(np.hypot(*model.image_shape))  # m, of what is cut out
    return model.markers.diameter / diagonal * (1 - 2 * view.border)


def _folder(folder: Path) -> Generator[Frame, None, None]:
    files = [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES]
    for path in sorted(files, key=lambda path: (path.name != _UNTOUCHED, path.name)):
        picture = read_picture(path)
        if picture is None:
            raise UserError(f"{path} is no picture")
        yield picture


def _video(path: Path) -> Generator[Frame, None, None]:
    capture = cv2.VideoCapture(str(path))
    try:
        while (read := capture.read())[0]:
            yield cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB)
    finally:
        capture.release()


def _device_of(model: SensorModel, serial: str) -> str:
    return find_sensor_camera(model, serial).device

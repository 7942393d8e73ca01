"""Cameras and network streams through OpenCV: always the newest frame.

A thread keeps only the newest frame of the driver's queue; a slow reader of the queue itself would
get old frames (2 s old after 3 s). Stamps are taken right after the grab, because FFmpeg's own are
unusable. A source that fails is opened again until it comes back; meanwhile the last frame is
returned with its old stamp.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from touchgoal.control.interfaces import Frame
from touchgoal.control.sensors.image_integrity import FrozenParts, JpegDecoder
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.runtime.errors import UserError

_OPEN_TIMEOUT = 5.0  # s to open it the first time: the first frame may take longer to come
_REOPEN_INTERVAL = 0.5  # s between attempts
_LATE_PERIODS = 3.0  # periods without a frame that mean a problem
_MANUAL_EXPOSURE = 1  # V4L2_EXPOSURE_MANUAL
_FFMPEG_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"
_JPEG = b"\xff\xd8"  # first bytes of a JPEG


@dataclass(frozen=True)
class VideoConfig:
    """Source of images and how to read it."""

    # index of a camera (`0`), device (`/dev/video2`) or address of an MJPEG stream (`http://...`)
    source: str
    size: tuple[int, int] | None = None  # (width, height) to request; None: the camera's own
    rate: float = 25.0  # Hz; requested from a camera, and expected by `problem`
    # exposure, white_balance: fixed values for a camera, in V4L2's units (`v4l2-ctl --list-ctrls`;
    # usually 0.1 ms, and kelvin); None: unchanged
    exposure: float | None = None
    white_balance: int | None = None
    timeout: float = 1.0  # s without a frame after which a stream counts as lost, to open again
    # s after which an identical image, or part of one, counts as old; infinity for rendered
    # images, which lack the noise of real ones
    frozen_after: float = 0.5
    # number of identical images in a row that must also have come before they count as old; for a
    # lock-step twin, whose time is not the wall clock's
    frozen_images: int = 0
    # looks `source` up at each opening, for a serial number
    device: Callable[[], str] | None = None

    @property
    def is_camera(self) -> bool:
        """Whether it is a camera of this computer."""
        known = self.device is not None or self.source.isdigit()
        return known or self.source.startswith("/dev/")


class _Quiet:
    """Switch for OpenCV's messages, off while any camera is open; `problem` replaces them."""

    def __init__(self) -> None:
        self._lock, self._open, self._level = threading.Lock(), 0, 0

    def begin(self) -> None:
        with self._lock:
            self._open += 1
            if self._open == 1:
                self._level = cv2.utils.logging.getLogLevel()
                cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_FATAL)

    def end(self) -> None:
        with self._lock:
            self._open -= 1
            if self._open == 0:
                cv2.utils.logging.setLogLevel(self._level)


_quiet = _Quiet()


@contextmanager
def _quiet_ffmpeg() -> Iterator[None]:
    """Set FFmpeg's log level for the captures opened within; OpenCV reads it with the first one."""
    before = os.environ.get(_FFMPEG_LEVEL)
    os.environ.setdefault(_FFMPEG_LEVEL, "-8")
    try:
        yield
    finally:
        if before is None:
            del os.environ[_FFMPEG_LEVEL]


class VideoCamera:
    """The Camera interface; UserError if the source does not open, or a camera not at that size."""

    def __init__(self, config: VideoConfig) -> None:
        self.config = config
        _quiet.begin()
        try:
            self._capture = _open(config, _OPEN_TIMEOUT)
        except BaseException:
            _quiet.end()
            raise
        self._count = 0
        self._image: np.ndarray | None = None
        self._frozen_parts, self._decoder = FrozenParts(), JpegDecoder()
        self._same, self._frozen = 0, False  # images in a row with an unchanged part
        self._lost = self._refused = ""
        self._closed = False
        self._latest = LatestValue(f"camera {config.source}", self._take)

    @property
    def problem(self) -> str:
        """See Camera."""
        frame, now = self.read(), time.monotonic()
        if wrong := self._lost or self._refused:
            return f"{self.config.source} {wrong}"
        if self._frozen:
            still = now - frame.stamp
            return f"{self.config.source} or a part of it shows one image for {still:.1f} s"
        if now - frame.stamp > _LATE_PERIODS / self.config.rate:
            return f"{self.config.source} gave its last frame {now - frame.stamp:.2f} s ago"
        return ""

    def read(self) -> Frame:
        """See Camera."""
        return self._latest.read()

    def close(self) -> None:
        """See Camera."""
        if not self._closed:
            self._closed = True
            self._latest.close()
            self._capture.release()
            _quiet.end()

    def _take(self) -> Frame | None:
        grabbed = self._capture.grab()
        stamp = time.monotonic()
        read, image = self._capture.retrieve() if grabbed else (False, None)
        if not read or image is None:
            self._reopen()
            return None
        self._lost = ""
        image = self._checked(image)
        if image is None:
            return None
        self._count += 1
        self._image = image
        same_since = self._frozen_parts.update(image, stamp)
        self._same = self._same + 1 if same_since < stamp else 0
        still = stamp - same_since > self.config.frozen_after
        self._frozen = still and self._same > self.config.frozen_images
        return Frame(image, self._count, same_since if self._frozen else stamp)

    def _checked(self, image: np.ndarray) -> np.ndarray | None:
        """Return a grabbed JPEG or BGR image as RGB; None if it is broken or of another size."""
        if image.ndim == 2 and 1 in image.shape:
            decoded = self._decoder.decode(image.tobytes())
        else:
            decoded = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        before, self._refused = self._image, ""
        if decoded is None:
            self._refused = "sends broken images: check its cable"
        elif before is not None and decoded.shape != before.shape:
            was, now = (f"{x.shape[1]}x{x.shape[0]}" for x in (before, decoded))
            self._refused = f"sends {now} pixels instead of {was}: check that it is the same camera"
        return None if self._refused else decoded

    def _reopen(self) -> None:
        self._lost = "is gone: check its cable"
        self._capture.release()
        time.sleep(_REOPEN_INTERVAL)
        with suppress(UserError):  # not back yet
            self._capture = _open(self.config, self.config.timeout)


@_quiet_ffmpeg()
def _open(config: VideoConfig, timeout: float) -> Any:
    """Open the source; a stream within `timeout` s."""
    source = int(config.source) if config.source.isdigit() else config.source
    if config.device is not None:
        source = config.device()
    if config.is_camera:
        capture = cv2.VideoCapture(source, cv2.CAP_V4L2)
    else:
        opening = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1e3 * timeout)]
        reading = [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1e3 * config.timeout)]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, opening + reading)
        if _sends_jpeg(capture):
            return capture
        capture.release()
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, opening + reading)
    if not capture.isOpened():
        raise UserError(f"cannot open {config.source}: check cable, address and permission (video)")
    if config.is_camera:
        _configure_camera(capture, config)
    return capture


def _configure_camera(capture: Any, config: VideoConfig) -> None:
    """Set a camera's format, size and rate, and read them back: drivers ignore what they lack."""
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
    if config.size is not None:
        width, height = config.size
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        size = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
        got = tuple(int(capture.get(side)) for side in size)
        if got != config.size:
            capture.release()
            raise UserError(
                f"{config.source} gives {got[0]}x{got[1]} instead of {width}x{height}: choose a "
                "size that `v4l2-ctl --list-formats-ext` lists"
            )
    capture.set(cv2.CAP_PROP_FPS, config.rate)
    if config.exposure is not None:
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
        _lock(capture, config.source, "exposure", cv2.CAP_PROP_EXPOSURE, config.exposure)
    if config.white_balance is not None:
        capture.set(cv2.CAP_PROP_AUTO_WB, 0)
        value = config.white_balance
        _lock(capture, config.source, "white_balance", cv2.CAP_PROP_WB_TEMPERATURE, value)
    if int(capture.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter.fourcc(*"MJPG"):
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # the JPEGs themselves, see `_sends_jpeg`


def _lock(capture: Any, source: str, name: str, prop: int, wanted: float) -> None:
    """Set a control that is no longer automatic; UserError if it does not take."""
    capture.set(prop, wanted)
    if (got := capture.get(prop)) != wanted:
        capture.release()
        raise UserError(
            f"{source} keeps {name} {got:g} instead of {wanted:g}: choose a value that "
            "`v4l2-ctl --list-ctrls` allows"
        )


def _sends_jpeg(capture: Any) -> bool:
    """Switch a stream to undecoded JPEGs and return whether it sends them.

    OpenCV's own decoder shows a broken one as if it were whole.
    """
    if not capture.isOpened() or not capture.set(cv2.CAP_PROP_FORMAT, -1):
        return False
    read, first = capture.read()
    return bool(read) and first is not None and first.tobytes()[:2] == _JPEG

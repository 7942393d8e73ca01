"""Cameras over a real MJPEG stream, real files and USB: newest frame, rate, stall, freeze, return, replug."""

import os
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numbered_images import BITS, numbered, until

from touchgoal.control.interfaces import DriverError, TactileSensor
from touchgoal.control.sensors import video
from touchgoal.control.sensors.fingertip_source import find_sensor_camera, list_cameras
from touchgoal.control.sensors.image_integrity import FrozenParts
from touchgoal.control.sensors.live_image import StreamServer
from touchgoal.control.sensors.tactile_camera import (
    DIGIT_CROP,
    GELSIGHT_MINI_CROP,
    NO_CROP,
    TactileCamera,
    crop_to_sensor,
    fingertip_view,
)
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import (
    DIGIT,
    GELSIGHT_MINI,
    GELSIGHT_MINI_MARKERS,
    SensorModel,
)
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.tactile.markers import draw, rest_positions
from touchgoal.sim_envs.twin.image_process import Stream


def number(image: np.ndarray) -> int:
    return sum(int(image[16, bit * 10 + 5, 0] > 128) << bit for bit in range(BITS))


class Streamer:
    """A twin's stream of numbered images at 50 Hz."""

    def __init__(self, port: int = 0) -> None:
        self.stream, self.count, self.shape = Stream(), 0, (96, 128)
        self._server = StreamServer({"stream": self.stream}, "127.0.0.1", port)
        self.port, self.url = self._server.port, f"http://127.0.0.1:{self._server.port}/stream"
        threading.Thread(target=self._play, daemon=True).start()

    def _play(self) -> None:
        while not self.stream.ended:
            if self.stream.has_viewers:
                self.count += 1
                self.stream.publish(numbered(self.count, self.shape))
            time.sleep(0.02)

    def hang_up(self) -> None:
        self._server.close()


@pytest.fixture
def streamer() -> Iterator[Streamer]:
    server = Streamer()
    yield server
    server.hang_up()


@pytest.fixture
def camera(streamer: Streamer) -> Iterator[VideoCamera]:
    camera = VideoCamera(VideoConfig(streamer.url, rate=50.0))
    yield camera
    camera.close()


def test_a_slow_reader_sees_the_present(streamer: Streamer, camera: VideoCamera) -> None:
    assert camera.read().image.shape == (96, 128, 3)
    time.sleep(1.0)
    frame = camera.read()
    # A queue would still hold the first images, 50 behind.
    assert streamer.count - number(frame.image) < 20 < frame.sequence
    assert frame.image[80, 64, 0] > 140 > 60 > frame.image[80, 64, 2], "RGB, not BGR"
    assert frame.stamp <= time.monotonic()
    until(lambda: camera.problem == "")


def test_a_frozen_image_grows_old_and_is_said(streamer: Streamer, camera: VideoCamera) -> None:
    camera.read()
    streamer.stream.frozen = np.inf
    until(lambda: "one image" in camera.problem)
    frozen = camera.read()
    time.sleep(0.2)
    assert camera.read().stamp == frozen.stamp and camera.read().sequence > frozen.sequence
    streamer.stream.frozen = 0.0
    until(lambda: camera.read().stamp > frozen.stamp and camera.problem == "")


@pytest.mark.parametrize(("fault", "says"), [("stalled", "last frame|gone"), ("halved", "broken")])
def test_without_a_whole_new_image_the_last_one_stays_and_it_is_said(
    streamer: Streamer, camera: VideoCamera, fault: str, says: str
) -> None:
    """FFmpeg would silently fill the rest of an image cut in half from the one before."""
    until(lambda: camera.problem == "")
    setattr(streamer.stream, fault, np.inf)
    until(lambda: bool(re.search(says, camera.problem)))
    last = camera.read()
    time.sleep(0.2)
    assert camera.read() is last, "no new image, so that ages tell"
    setattr(streamer.stream, fault, 0.0)
    until(lambda: camera.read().sequence > last.sequence and camera.problem == "")


def test_another_size_in_a_run_is_refused_and_said(streamer: Streamer, camera: VideoCamera) -> None:
    until(lambda: camera.problem == "")
    streamer.shape = (192, 256)
    until(lambda: "256x192 pixels instead of 128x96" in camera.problem)
    assert camera.read().image.shape == (96, 128, 3)


GEL = load(GELSIGHT_MINI.sensor_file).background
REAL = Path(__file__).parents[2] / "shared" / "data"  # beside the project; not part of it


def noisy(seed: int, model: SensorModel = GELSIGHT_MINI) -> np.ndarray:
    """A gel's image, with dots (if it has some) that have moved by a few pixels."""
    image, rng = GEL.copy(), np.random.default_rng(seed)
    if model.markers is not None:
        rest = rest_positions(model.markers, model.image_shape, model.pixel_pitch)
        moved = rest + rng.uniform(-6, 6, 2)
        draw(image, moved.astype(np.float32), model.markers.diameter / 2 / model.pixel_pitch)
    return np.clip(image + rng.normal(0, 1.5, GEL.shape), 0, 255).astype(np.uint8)


def test_a_part_that_stands_still_counts_as_frozen_and_a_dark_part_does_not() -> None:
    parts = FrozenParts()
    for k in range(60):
        image = noisy(k)
        image[-40:] = 0  # never lit: tells nothing
        if k >= 40:
            image[120:180] = noisy(39)[120:180]
        since = parts.update(image, k / 30)
        assert since == pytest.approx((39 if k >= 40 else k) / 30, abs=1e-9)


def test_a_lost_stream_is_joined_again(streamer: Streamer, camera: VideoCamera) -> None:
    last = camera.read().sequence
    streamer.hang_up()
    until(lambda: "gone" in camera.problem)
    again = Streamer(streamer.port)
    until(lambda: camera.problem == "" and camera.read().sequence > last + 5)
    again.hang_up()


def test_a_fingertip_is_cut_turned_and_scaled(tmp_path: Path) -> None:
    whole = np.zeros((616, 820, 3), np.uint8)
    whole[88:528, 117:703] = (10, 200, 30)  # all but a seventh at each side
    seen = crop_to_sensor(whole, GELSIGHT_MINI, GELSIGHT_MINI_CROP)
    assert seen.shape == (240, 320, 3) and (seen[1:-1, 1:-1] == (10, 200, 30)).all()
    lying = np.zeros((240, 320, 3), np.uint8)
    lying[:, -1] = 255  # its right edge is the top of the upright image
    assert crop_to_sensor(lying, DIGIT, DIGIT_CROP).shape == (320, 240, 3)
    assert (crop_to_sensor(lying, DIGIT, DIGIT_CROP)[0] == 255).all()
    with pytest.raises(UserError, match="quarter_turns"):
        crop_to_sensor(lying, DIGIT, NO_CROP)
    cv2.imwrite(str(tmp_path / "0.png"), whole[..., ::-1])
    sensor = TactileCamera(
        VideoCamera(VideoConfig(str(tmp_path / "%d.png"))), GELSIGHT_MINI, GELSIGHT_MINI_CROP
    )
    assert sensor.read().image.shape[:2] == sensor.model.image_shape
    assert sensor.read() is sensor.read() and isinstance(sensor, TactileSensor)
    sensor.close()


def test_a_silent_stream_is_said(streamer: Streamer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_OPEN_TIMEOUT", 0.5)
    streamer.stream.stalled = np.inf
    with pytest.raises((UserError, DriverError)):
        VideoCamera(VideoConfig(streamer.url)).read()


def plug(root: Path, node: int, product: str, serial: str, index: int = 0) -> None:
    """Nodes as Linux makes them: class/videoN/device links to an interface of a USB device."""
    usb = root / "devices" / f"usb-{serial}"
    (usb / "1-1:1.0").mkdir(parents=True, exist_ok=True)
    for name, text in (("product", product), ("serial", serial), ("idProduct", "636d")):
        (usb / name).write_text(text + "\n")
    folder = root / "class" / f"video{node}"
    folder.mkdir(parents=True)
    (folder / "device").symlink_to(usb / "1-1:1.0")
    (folder / "name").write_text(f"{product}: {product}\n")
    (folder / "index").write_text(f"{index}\n")


def test_fingertips_are_found_by_name_and_serial_number(tmp_path: Path) -> None:
    plug(tmp_path, 0, "Integrated Webcam", "W1")
    plug(tmp_path, 2, "GelSight Mini R0B 28GH-EJZ8", "28GHEJZ8")
    plug(tmp_path, 3, "GelSight Mini R0B 28GH-EJZ8", "28GHEJZ8", index=1)  # metadata
    plug(tmp_path, 10, "DIGIT", "D20001")
    root = tmp_path / "class"
    assert [c.device for c in list_cameras(root)] == ["/dev/video0", "/dev/video2", "/dev/video10"]
    assert find_sensor_camera(GELSIGHT_MINI_MARKERS, root=root).device == "/dev/video2"
    assert find_sensor_camera(DIGIT, "D20001", root).device == "/dev/video10"
    with pytest.raises(UserError, match="GelSight Mini R0B 28GH-EJZ8"):
        find_sensor_camera(DIGIT, "D99", root)
    plug(tmp_path, 12, "DIGIT", "D20002")
    with pytest.raises(UserError, match="D20001, D20002"):
        find_sensor_camera(DIGIT, root=root)


def test_a_fingertips_view_is_chosen_by_its_model_for_a_device_too() -> None:
    assert fingertip_view(DIGIT, "/dev/video3", None) == DIGIT_CROP
    assert fingertip_view(GELSIGHT_MINI, "28GHEJZ8", None) == GELSIGHT_MINI_CROP
    assert fingertip_view(GELSIGHT_MINI, "http://127.0.0.1/left", None) == NO_CROP
    assert fingertip_view(DIGIT, "D20001", 0.1) == replace(DIGIT_CROP, border=0.1)


class PluggedCamera:
    """OpenCV's capture of a camera that gives one image and is then unplugged."""

    def __init__(self, keeps: float = 0.0) -> None:
        self.set_to: dict[int, float] = {}
        self.keeps, self.grabs = keeps, 0

    def isOpened(self) -> bool:
        return True

    def set(self, prop: int, value: float) -> bool:
        self.set_to[prop] = value
        return True

    def get(self, prop: int) -> float:
        return self.keeps or self.set_to.get(prop, 0.0)

    def grab(self) -> bool:
        self.grabs += 1
        return self.grabs == 1

    def retrieve(self) -> tuple[bool, np.ndarray]:
        data = cv2.imencode(".jpg", numbered(self.grabs))[1]
        return True, data.reshape(1, -1)

    def release(self) -> None: ...


def test_after_a_replug_the_serial_number_is_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, devices = [], iter(["/dev/video2", "/dev/video4", *["/dev/video6"] * 99])

    def opened(source: str, _: int) -> PluggedCamera:
        asked.append(source)
        return PluggedCamera()

    monkeypatch.setattr(cv2, "VideoCapture", opened)
    camera = VideoCamera(VideoConfig("28GHEJZ8", device=lambda: next(devices)))
    assert camera.read().image.shape == (96, 128, 3)
    until(lambda: len(asked) > 1)
    camera.close()
    assert asked[:2] == ["/dev/video2", "/dev/video4"]


def test_exposure_and_white_balance_are_locked_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    plugged = PluggedCamera()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: plugged)
    VideoCamera(VideoConfig("0", exposure=120.0, white_balance=4600)).close()
    assert plugged.set_to[cv2.CAP_PROP_AUTO_EXPOSURE] == 1  # V4L2_EXPOSURE_MANUAL
    assert plugged.set_to[cv2.CAP_PROP_EXPOSURE] == 120
    assert plugged.set_to[cv2.CAP_PROP_AUTO_WB] == 0
    assert plugged.set_to[cv2.CAP_PROP_WB_TEMPERATURE] == 4600
    plugged.keeps = 99.0
    with pytest.raises(UserError, match="keeps exposure 99 instead of 120"):
        VideoCamera(VideoConfig("0", exposure=120.0))


def test_opencv_is_quiet_only_while_a_camera_is_open(streamer: Streamer) -> None:
    before = cv2.utils.logging.getLogLevel()
    cameras = [VideoCamera(VideoConfig(streamer.url, rate=50.0)) for _ in range(2)]
    cameras[0].close()
    assert cv2.utils.logging.getLogLevel() == cv2.utils.logging.LOG_LEVEL_FATAL
    cameras[1].close()
    cameras[1].close()
    assert cv2.utils.logging.getLogLevel() == before
    assert "OPENCV_FFMPEG_LOGLEVEL" not in os.environ

"""Cameras over a real MJPEG stream and real files: newest frame, rate, stall, freeze, return."""

import itertools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
from numbered_pictures import BITS, numbered, until

from touchgoal.control.interfaces import DriverError, TactileSensor
from touchgoal.control.sensors import video
from touchgoal.control.sensors.fingertip_source import fingertip_video
from touchgoal.control.sensors.picture_integrity import BrokenBlocks, FrozenParts, JpegDecoder
from touchgoal.control.sensors.tactile_camera import (
    DIGIT_CROP,
    GELSIGHT_MINI_CROP,
    NO_CROP,
    TactileCamera,
    crop_to_sensor,
)
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import DIGIT, GELSIGHT_MINI, GELSIGHT_MINI_MARKERS
from touchgoal.runtime.errors import UserError


def number(image: np.ndarray) -> int:
    return sum(int(image[16, bit * 10 + 5, 0] > 128) << bit for bit in range(BITS))


class Streamer(ThreadingHTTPServer):
    """An MJPEG server at 50 Hz that can stall, freeze on a picture, or hang up."""

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Stream)
        self.count, self.stalled, self.frozen, self.shut = 0, False, False, False
        # What is drawn, and done to the JPEG.
        self.picture: Callable[[int], np.ndarray] = numbered
        self.damage: Callable[[bytes], bytes] = bytes
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()
        threading.Thread(target=self._count, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server_port}/stream.mjpg"

    def _count(self) -> None:
        while not self.shut:
            self.count += not self.frozen
            time.sleep(0.02)

    def hang_up(self) -> None:
        self.shut = True
        self.shutdown()
        self.server_close()


class _Stream(BaseHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None: ...

    def do_GET(self) -> None:
        streamer = self.server
        assert isinstance(streamer, Streamer)
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        try:
            while not streamer.shut:
                if not streamer.stalled:
                    picture = cv2.cvtColor(streamer.picture(streamer.count), cv2.COLOR_RGB2BGR)
                    jpeg = streamer.damage(cv2.imencode(".jpg", picture)[1].tobytes())
                    head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                    self.wfile.write(b"--frame\r\n" + head.encode() + jpeg + b"\r\n")
                time.sleep(0.02)
        except OSError:
            pass  # the reader is gone


@pytest.fixture
def streamer() -> Iterator[Streamer]:
    server = Streamer()
    yield server
    if not server.shut:
        server.hang_up()


def test_a_slow_reader_of_a_stream_sees_the_present(streamer: Streamer) -> None:
    camera = VideoCamera(VideoConfig(streamer.url, rate=50.0))
    assert camera.read().image.shape == (96, 128, 3)
    time.sleep(1.0)
    frame = camera.read()
    # A queue would still hold the first pictures, 50 behind.
    assert streamer.count - number(frame.image) < 20 < frame.sequence
    assert frame.image[80, 64, 0] > 140 > 60 > frame.image[80, 64, 2], "RGB, not BGR"
    assert frame.stamp <= time.monotonic()
    until(lambda: camera.problem == "")
    camera.close()


def test_a_frozen_picture_and_a_stalled_stream_grow_old_and_are_said(streamer: Streamer) -> None:
    camera = VideoCamera(VideoConfig(streamer.url, rate=50.0))
    camera.read()
    streamer.frozen = True
    until(lambda: "one picture" in camera.problem)
    frozen = camera.read()
    time.sleep(0.2)
    assert camera.read().stamp == frozen.stamp and camera.read().sequence > frozen.sequence
    streamer.frozen = False
    until(lambda: camera.read().stamp > frozen.stamp and camera.problem == "")
    streamer.stalled = True
    until(lambda: "last frame" in camera.problem or "gone" in camera.problem)
    stalled = camera.read()
    time.sleep(0.2)
    assert camera.read() is stalled
    streamer.stalled = False
    until(lambda: camera.read().sequence > stalled.sequence and camera.problem == "")
    camera.close()


def test_pictures_cut_in_half_are_refused_and_said(streamer: Streamer) -> None:
    """FFmpeg would silently fill the rest from the picture before."""
    camera = VideoCamera(VideoConfig(streamer.url, rate=50.0))
    until(lambda: camera.problem == "")
    streamer.damage = lambda jpeg: jpeg[: len(jpeg) // 2]
    until(lambda: "broken" in camera.problem)
    last = camera.read()
    time.sleep(0.2)
    assert camera.read() is last, "no new picture, so that ages tell"
    streamer.damage = bytes
    until(lambda: camera.read().sequence > last.sequence and camera.problem == "")
    camera.close()


def test_another_size_in_mid_run_is_refused_and_said(streamer: Streamer) -> None:
    camera = VideoCamera(VideoConfig(streamer.url, rate=50.0))
    until(lambda: camera.problem == "")
    streamer.picture = lambda k: numbered(k, (192, 256))
    until(lambda: "256x192 pixels instead of 128x96" in camera.problem)
    assert camera.read().image.shape == (96, 128, 3)
    camera.close()


GEL = load(GELSIGHT_MINI.sensor_file).background


def noisy(seed: int, noise: float = 1.5) -> np.ndarray:
    noise_ = np.random.default_rng(seed).normal(0, noise, GEL.shape)
    return np.clip(GEL + noise_, 0, 255).astype(np.uint8)


def test_a_part_that_stands_still_counts_as_frozen_and_a_dark_part_does_not() -> None:
    parts = FrozenParts()
    for k in range(60):
        picture = noisy(k)
        picture[-40:] = 0  # never lit: tells nothing
        if k >= 40:
            picture[120:180] = noisy(39)[120:180]
        since = parts.update(picture, k / 30)
        assert since == pytest.approx((39 if k >= 40 else k) / 30, abs=1e-9)


def test_broken_jpegs_of_a_gel_are_refused_and_presses_of_a_real_one_are_not() -> None:
    """Random bytes; decoders show them as blocks, which read as millimetres of indentation."""
    rng, decoder, passed = np.random.default_rng(0), JpegDecoder(), 0
    for k in range(100):
        data = cv2.imencode(".jpg", noisy(k), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        image = decoder.decode(damaged(data, 20, rng))
        if image is not None and not is_broken(image[..., ::-1], noisy(1000)):
            seen = cv2.blur(np.abs(image[..., ::-1].astype(np.float32) - GEL), (8, 8))
            passed += seen.max() > 20
    assert passed <= 5  # in 100 with visible damage; without the checks it is half
    assert all(not is_broken(noisy(k, 3.0), noisy(1000)) for k in range(20))
    real = sorted(Path("/work/shared/data/mini_presses").glob("ball*.png"))
    pictures = [p for path in real if (p := cv2.imread(str(path))) is not None]
    assert not any(is_broken(p, pictures[0]) for p in pictures)


def is_broken(image: np.ndarray, before: np.ndarray, dots: float = 0.0) -> bool:
    blocks = BrokenBlocks(dots)
    blocks.update(before)
    return blocks.update(image)


def damaged(data: bytes, count: int, rng: np.random.Generator) -> bytes:
    """A JPEG with so many bytes of its picture replaced."""
    broken = bytearray(data)
    start = broken.index(b"\xff\xda") + 14
    for _ in range(count):
        broken[rng.integers(start, len(broken) - 2)] = rng.integers(256)
    return bytes(broken)


def with_dots(seed: int) -> np.ndarray:
    """A picture of a gel with dots that have moved by a few pixels, BGR."""
    picture, dots = noisy(seed, 0.0), GELSIGHT_MINI_MARKERS.markers
    assert dots is not None
    pitch, radius = dots.pitch / GELSIGHT_MINI.pixel_pitch, dots.diameter / 2
    shift = np.random.default_rng(seed).uniform(-6, 6, 2)
    for row in range(dots.rows):
        for column in range(dots.columns):
            x, y = np.array([column + 0.5, row + 0.5]) * pitch + shift
            centre = (round(x), round(y))
            cv2.circle(picture, centre, round(radius / GELSIGHT_MINI.pixel_pitch), (25,) * 3, -1)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0).astype(np.float64)  # as optics do
    picture += np.random.default_rng(seed).normal(0, 1.5, picture.shape)
    return np.clip(picture, 0, 255).astype(np.uint8)


def test_broken_jpegs_of_a_gel_with_dots_are_refused_and_moving_dots_are_not() -> None:
    real = sorted(Path("/work/shared/data/mini_markers").glob("*.png"))
    clips = [[with_dots(k) for k in range(30)]]
    clips += [[p for path in real if (p := cv2.imread(str(path))) is not None]] * bool(real)
    dots = fingertip_video("http://left", GELSIGHT_MINI_MARKERS).dots
    decoder, rng = JpegDecoder(), np.random.default_rng(0)
    for clip in clips:
        jpegs = {
            quality: [
                cv2.imencode(".jpg", p, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
                for p in clip
            ]
            for quality in (75, 95)
        }
        for sent in jpegs.values():
            whole = [decoder.decode(data) for data in sent]
            for before, image in itertools.pairwise(whole):
                assert before is not None and image is not None
                assert not is_broken(image, before, dots)
        passed = 0
        for k in range(100):
            before, good = (decoder.decode(jpegs[95][(k + i) % len(clip)]) for i in (0, 1))
            image = decoder.decode(damaged(jpegs[95][(k + 1) % len(clip)], 20, rng))
            assert before is not None and good is not None
            if image is not None and not is_broken(image, before, dots):
                passed += cv2.blur(np.abs(image.astype(np.float32) - good), (8, 8)).max() > 20
        assert passed <= 5  # in 100 with visible damage


def test_a_lost_stream_is_joined_again(streamer: Streamer) -> None:
    camera = VideoCamera(VideoConfig(streamer.url, rate=50.0))
    last = camera.read().sequence
    streamer.hang_up()
    until(lambda: "gone" in camera.problem)
    again = Streamer(streamer.server_port)
    until(lambda: camera.problem == "" and camera.read().sequence > last + 5)
    camera.close()
    again.hang_up()


def test_a_missing_source_is_said_in_a_line(tmp_path: Path) -> None:
    for source in (str(tmp_path / "none.mp4"), "http://127.0.0.1:9/x", "77"):
        with pytest.raises(UserError, match="cannot open"):
            VideoCamera(VideoConfig(source))


def test_a_fingertip_is_cut_turned_and_scaled(tmp_path: Path) -> None:
    whole = np.zeros((616, 820, 3), np.uint8)
    whole[88:528, 117:703] = (10, 200, 30)  # all but a seventh at each side
    seen = crop_to_sensor(whole, GELSIGHT_MINI, GELSIGHT_MINI_CROP)
    assert seen.shape == (240, 320, 3) and (seen[1:-1, 1:-1] == (10, 200, 30)).all()
    lying = np.zeros((240, 320, 3), np.uint8)
    lying[:, -1] = 255  # its right edge is the top of the upright picture
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


def test_a_stream_that_never_gives_a_picture_is_said(
    streamer: Streamer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "_OPEN_TIMEOUT", 0.5)
    streamer.stalled = True
    with pytest.raises((UserError, DriverError)):
        VideoCamera(VideoConfig(streamer.url)).read()


def test_opencv_is_quiet_only_while_a_camera_is_open(streamer: Streamer) -> None:
    """Importing touchgoal changes neither OpenCV's log level nor its environment variables."""
    program = (
        "import os, cv2; before = cv2.utils.logging.getLogLevel(), dict(os.environ)\n"
        "import touchgoal, touchgoal.control.sensors.video\n"
        "after = {k: v for k, v in os.environ.items() if k != 'MUJOCO_GL'}\n"
        "before[1].pop('MUJOCO_GL', None)\n"
        "assert (cv2.utils.logging.getLogLevel(), after) == before"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    before = cv2.utils.logging.getLogLevel()
    cameras = [VideoCamera(VideoConfig(streamer.url, rate=50.0)) for _ in range(2)]
    cameras[0].close()
    assert cv2.utils.logging.getLogLevel() == cv2.utils.logging.LOG_LEVEL_FATAL
    cameras[1].close()
    cameras[1].close()
    assert cv2.utils.logging.getLogLevel() == before
    assert "OPENCV_FFMPEG_LOGLEVEL" not in os.environ

"""The cell's cameras and fingertip sensors as MJPEG streams over HTTP, with faults to order."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
from jaxtyping import UInt8

from touchgoal.control import features as ft
from touchgoal.sim_envs.twin.cell import SimulatedCell

CAMERA_RATE = 30  # Hz, a webcam's
_CAMERA_NOISE = 1.5  # counts: by it a driver tells a still scene from a frozen camera
_QUALITY = 95  # of JPEG; real GelSight Minis send MJPEG, too
_JPEG_HEADER = 640  # bytes of OpenCV's
_SENDING_TIMEOUT = 2.0  # s
_POLL_INTERVAL = 0.2  # s between looks at whether the stream is to end

Picture = UInt8[np.ndarray, "h w 3"]


@dataclass
class Stream:
    """One source of pictures.

    Attributes:
        rate: Hz, simulated.
        render: takes a picture, RGB.
        stalled, frozen, lost, broken, halved: until when (s, time.monotonic) nothing comes, one picture
            repeats, clients are cut off and turned away, JPEGs have wrong bytes or are cut in half.
        clients, count, sent: who watches; pictures published; pictures sent to the last who came.
    """

    rate: int
    render: Callable[[], Picture]
    stalled: float = 0.0
    frozen: float = 0.0
    lost: float = 0.0
    broken: float = 0.0
    halved: float = 0.0
    clients: int = 0
    count: int = 0
    sent: int = 0
    picture: Picture | None = None
    condition: threading.Condition = field(default_factory=threading.Condition)

    def publish(self) -> None:
        """A new picture for whoever watches."""
        now = time.monotonic()
        if now < self.stalled or not self.clients:
            return
        picture = self.render()  # even if it is not shown: a sensor goes on feeling
        with self.condition:
            if now >= self.frozen or self.picture is None:
                self.picture = picture
            self.count += 1
            self.condition.notify_all()

    def wait_until_sent(self) -> None:
        """Until the last picture is on its way to whoever watches."""
        with self.condition:
            self.condition.wait_for(
                lambda: self.sent >= self.count or not self.clients, _SENDING_TIMEOUT
            )


class Streams:
    """Serves every camera and sensor of the cell at `http://host:port/NAME`.

    Attributes:
        streams: by name, such as tactile_left.
        time_is_held: whether a client lets time go on, which must get a picture before it does.
    """

    def __init__(self, cell: SimulatedCell, host: str, port: int) -> None:
        self._cell, self._host = cell, host
        self.time_is_held: Callable[[], bool] = lambda: False
        self._rng = np.random.default_rng(0)
        self._noise = np.empty(0)
        env = cell.env
        self.streams = {
            camera: Stream(CAMERA_RATE, partial(self._picture, camera))
            for camera in env.config.cameras
        }
        if env.config.tactile:
            for side, key in enumerate(ft.TACTILE):
                render = partial(self._tactile_image, side)
                name = key.removeprefix(ft.IMAGE_PREFIX)
                self.streams[name] = Stream(round(env.sensor.frame_rate), render)
        handler = type("Handler", (_Handler,), {"streams": self.streams})
        self._server = ThreadingHTTPServer((host, port), handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    def addresses(self) -> dict[str, str]:
        """Address of each stream, by its name."""
        port = self._server.server_address[1]
        return {name: f"http://{self._host}:{port}/{name}" for name in self.streams}

    def receive(self) -> None:
        """Nobody says anything here."""

    def hold(self) -> None:
        """No picture is due while time stands."""

    def send(self) -> None:
        """Take the pictures that are due."""
        due = [s for s in self.streams.values() if _is_due(self._cell.steps, s.rate)]
        if due:
            self._cell.env.update_contacts()  # watched or not: watching must not change the physics
        for stream in due:
            stream.publish()
            if self.time_is_held():
                stream.wait_until_sent()

    def sent(self) -> dict[str, int]:
        """How many pictures of each stream are on their way so far."""
        return {name: stream.sent for name, stream in self.streams.items()}

    def reset(self) -> None:
        """From here on the cameras' noise is that of a twin that begins."""
        self._rng = np.random.default_rng(0)
        self._noise = np.empty(0)

    def close(self) -> None:
        """Hang up on everyone."""
        for stream in self.streams.values():
            stream.lost = np.inf
        self._server.shutdown()
        self._server.server_close()

    def _picture(self, camera: str) -> Picture:
        picture = self._cell.env.render_camera(camera)
        if self._noise.shape != picture.shape:
            self._noise = self._rng.normal(0.0, _CAMERA_NOISE, picture.shape)
        # one field of noise, shifted: drawing anew takes longer than the picture
        noise = np.roll(self._noise, self._rng.integers(0, picture.shape[:2]), axis=(0, 1))
        return np.clip(picture + noise, 0, 255).astype(np.uint8)

    def _tactile_image(self, side: int) -> Picture:
        return self._cell.env.read_tactile(side).image


def _with_random_bytes(jpeg: UInt8[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    """With 20 bytes of what follows the header replaced."""
    rng, damaged = np.random.default_rng(), jpeg.copy()
    places = rng.integers(_JPEG_HEADER, len(jpeg) - 2, 20)
    damaged[places] = rng.integers(0, 256, 20)
    return damaged


def _is_due(steps: int, rate: int) -> bool:
    """Whether something at `rate` Hz is due in this millisecond."""
    return steps * rate // 1000 > (steps - 1) * rate // 1000


class _Handler(BaseHTTPRequestHandler):
    """Sends one stream to one client until either is gone."""

    streams: dict[str, Stream]

    def do_GET(self) -> None:  # noqa: N802, the base class's name
        """Serve a stream."""
        stream = self.streams.get(self.path.strip("/"))
        if stream is None:
            self.send_error(404, "there are: " + ", ".join(self.streams))
            return
        if time.monotonic() < stream.lost:
            self.close_connection = True
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        with stream.condition:
            stream.clients += 1
            stream.sent = stream.count
        try:
            self._serve(stream)
        except OSError:  # the client has gone
            pass
        finally:
            with stream.condition:
                stream.clients -= 1

    def _serve(self, stream: Stream) -> None:
        seen = stream.sent
        while time.monotonic() >= stream.lost:
            with stream.condition:
                if stream.count == seen and not stream.condition.wait(_POLL_INTERVAL):
                    continue
                seen, picture = stream.count, stream.picture
            assert picture is not None
            now = time.monotonic()
            bgr = np.ascontiguousarray(picture[..., ::-1])
            _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            if now < stream.halved:
                jpeg = jpeg[: len(jpeg) // 2]
            elif now < stream.broken:
                jpeg = _with_random_bytes(jpeg)
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            self.wfile.write(head.encode() + jpeg.tobytes() + b"\r\n")
            with stream.condition:
                stream.sent = seen
                stream.condition.notify_all()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

"""MJPEG streams over HTTP, with faults on request."""

import threading
import time
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
from jaxtyping import UInt8

_QUALITY = 95  # JPEG; real GelSight Minis send MJPEG, too
_JPEG_HEADER = 640  # bytes of OpenCV's
_SENDING_TIMEOUT = 2.0  # s
_POLL_INTERVAL = 0.2  # s between looks at whether the stream is to end

Image = UInt8[np.ndarray, "h w 3"]


@dataclass(eq=False)
class Stream:
    """One stream of images."""

    # stalled, frozen, lost, broken, halved: until when (time.monotonic) nothing comes, one image
    # repeats, clients are cut off and turned away, JPEGs have wrong bytes or are cut in half
    stalled: float = 0.0
    frozen: float = 0.0
    lost: float = 0.0
    broken: float = 0.0
    halved: float = 0.0
    # clients, count, sent: number of viewers; images published; images sent to the last viewer
    clients: int = 0
    count: int = 0
    sent: int = 0
    image: Image | None = None
    condition: threading.Condition = field(default_factory=threading.Condition)

    @property
    def has_viewers(self) -> bool:
        """Whether a client would get an image."""
        return self.clients > 0 and time.monotonic() >= self.stalled

    def publish(self, image: Image) -> None:
        """Publish an image to all clients."""
        with self.condition:
            if time.monotonic() >= self.frozen or self.image is None:
                self.image = image
            self.count += 1
            self.condition.notify_all()

    def wait_until_sent(self) -> None:
        """Wait until the last image is on its way to its clients."""
        with self.condition:
            self.condition.wait_for(
                lambda: self.sent >= self.count or not self.clients, _SENDING_TIMEOUT
            )


class StreamServer:
    """Serves streams at `http://host:port/NAME`; `port` 0: any that is free."""

    def __init__(self, streams: dict[str, Stream], host: str, port: int) -> None:
        """`port` 0: any that is free. Raises OSError if it is taken."""
        self._streams = streams
        handler = type("Handler", (_Handler,), {"streams": streams})
        self._server = ThreadingHTTPServer((host, port), handler)
        self._server.daemon_threads = True
        self.port: int = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    def close(self) -> None:
        """Close all connections."""
        for stream in self._streams.values():
            stream.lost = np.inf
        self._server.shutdown()
        self._server.server_close()


def _with_random_bytes(jpeg: UInt8[np.ndarray, " n"]) -> UInt8[np.ndarray, " n"]:
    rng, damaged = np.random.default_rng(), jpeg.copy()
    places = rng.integers(_JPEG_HEADER, len(jpeg) - 2, 20)
    damaged[places] = rng.integers(0, 256, 20)
    return damaged


class _Handler(BaseHTTPRequestHandler):
    """Sends one stream to one client until either is gone."""

    streams: dict[str, Stream]

    def do_GET(self) -> None:  # noqa: N802, the base class's name
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
        last = stream.sent
        while time.monotonic() >= stream.lost:
            with stream.condition:
                if stream.count == last and not stream.condition.wait(_POLL_INTERVAL):
                    continue
                last, image = stream.count, stream.image
            assert image is not None
            now = time.monotonic()
            bgr = np.ascontiguousarray(image[..., ::-1])
            _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            if now < stream.halved:
                jpeg = jpeg[: len(jpeg) // 2]
            elif now < stream.broken:
                jpeg = _with_random_bytes(jpeg)
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            self.wfile.write(head.encode() + jpeg.tobytes() + b"\r\n")
            with stream.condition:
                stream.sent = last
                stream.condition.notify_all()

    def log_message(self, format: str, *args: object) -> None:
        pass

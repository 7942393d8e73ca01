"""MJPEG streams over HTTP: live images in any browser, for machines with and without a screen."""

import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2

from touchgoal.control.arrays import Image
from touchgoal.runtime.errors import UserError

_POLL_INTERVAL = 0.2  # s between looks at whether the stream is to end


@dataclass(eq=False)
class Stream:
    """One stream of images."""

    # clients, count, sent: number of viewers; images published; images sent to the last viewer
    clients: int = 0
    count: int = 0
    sent: int = 0
    image: Image | None = None
    lost: float = 0.0  # until when (time.monotonic) clients are cut off and turned away
    condition: threading.Condition = field(default_factory=threading.Condition)

    def publish(self, image: Image) -> None:
        """Publish an image to all clients."""
        with self.condition:
            self.image = image
            self.count += 1
            self.condition.notify_all()

    def encode(self, image: Image) -> bytes:
        """Return an image as a JPEG."""
        return cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()

    def is_open(self) -> bool:
        """Return whether clients are served."""
        return time.monotonic() >= self.lost

    def end(self) -> None:
        """Serve nobody any more."""
        self.lost = math.inf


class StreamServer:
    """Serves streams at `http://host:port/NAME`; `port` 0: any that is free. OSError if it is taken."""

    def __init__(self, streams: Mapping[str, Stream], host: str, port: int) -> None:
        self._streams = streams
        handler = type("Handler", (_Handler,), {"streams": streams})
        self._server = ThreadingHTTPServer((host, port), handler)
        self._server.daemon_threads = True
        self.port: int = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    def close(self) -> None:
        """Close all connections."""
        for stream in self._streams.values():
            stream.end()
        self._server.shutdown()
        self._server.server_close()


class LiveImage(StreamServer):
    """Stream of the latest image at http://127.0.0.1:port/; UserError if the port is taken."""

    def __init__(self, port: int) -> None:
        stream = Stream()
        try:
            super().__init__({"": stream}, "127.0.0.1", port)
        except OSError as error:
            raise UserError(f"port {port}: {error.strerror}; choose another with --port") from error
        self.address = f"http://127.0.0.1:{self.port}/"
        self.show = stream.publish


class _Handler(BaseHTTPRequestHandler):
    """Sends one stream to one client until either is gone."""

    streams: Mapping[str, Stream]

    def do_GET(self) -> None:  # noqa: N802, the base class's name
        stream = self.streams.get(self.path.strip("/"))
        if stream is None:
            self.send_error(404, "there are: " + ", ".join(self.streams))
            return
        if not stream.is_open():
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
        while stream.is_open():
            with stream.condition:
                if stream.count == last and not stream.condition.wait(_POLL_INTERVAL):
                    continue
                last, image = stream.count, stream.image
            assert image is not None
            jpeg = stream.encode(image)
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            self.wfile.write(head.encode() + jpeg + b"\r\n")
            with stream.condition:
                stream.sent = last
                stream.condition.notify_all()

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

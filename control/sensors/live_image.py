"""A live image in any browser, for machines with and without a screen."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2

from touchgoal.control.arrays import Image
from touchgoal.runtime.errors import UserError

_BOUNDARY = b"picture"
_PATIENCE = 1.0  # s without a new image after which the last one is sent again


class LiveImage:
    """MJPEG server of the latest image at http://127.0.0.1:port/; port 0 is any free one.

    UserError if the port is taken.
    """

    def __init__(self, port: int) -> None:
        self._changed, self._jpeg, self._closed = threading.Condition(), b"", False
        handler = type("Handler", (_Handler,), {"live": self})
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), handler)
        except OSError as error:
            raise UserError(f"port {port}: {error.strerror}; choose another with --port") from error
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    @property
    def address(self) -> str:
        """Address for a browser."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def show(self, image: Image) -> None:
        """Replace the image, RGB."""
        with self._changed:
            self._jpeg = cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()
            self._changed.notify_all()

    def next_jpeg(self) -> bytes | None:
        """Wait for the next image, or return the last one again; None when closed."""
        with self._changed:
            self._changed.wait(_PATIENCE)
            return None if self._closed else self._jpeg

    def close(self) -> None:
        """Stop serving."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    """Stream of images to one browser."""

    live: LiveImage

    def do_GET(self) -> None:
        self.send_response(200)
        kind = f"multipart/x-mixed-replace; boundary={_BOUNDARY.decode()}"
        self.send_header("Content-Type", kind)
        self.end_headers()
        try:
            while (jpeg := self.live.next_jpeg()) is not None:
                if jpeg:
                    head = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
                    self.wfile.write(b"--" + _BOUNDARY + b"\r\n" + head + jpeg + b"\r\n")
        except ConnectionError:
            pass  # the browser was closed

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

"""MJPEG streams with faults on request."""

import time
from dataclasses import dataclass

import numpy as np

from touchgoal.control.arrays import Image
from touchgoal.control.sensors import live_image

_JPEG_HEADER = 640  # bytes of OpenCV's
_SENDING_TIMEOUT = 2.0  # s


@dataclass(eq=False)
class Stream(live_image.Stream):
    """One stream of images, as a camera sends them that may fail."""

    # stalled, frozen, lost, broken, halved: until when (time.monotonic) nothing comes, one image
    # repeats, clients are cut off and turned away, JPEGs have wrong bytes or are cut in half
    stalled: float = 0.0
    frozen: float = 0.0
    lost: float = 0.0
    broken: float = 0.0
    halved: float = 0.0

    @property
    def has_viewers(self) -> bool:
        """Whether a client would get an image."""
        return self.clients > 0 and time.monotonic() >= self.stalled

    def publish(self, image: Image) -> None:
        """Publish an image to all clients."""
        frozen = self.image if time.monotonic() < self.frozen else None
        super().publish(image if frozen is None else frozen)

    def wait_until_sent(self) -> None:
        """Wait until the last image is on its way to its clients."""
        with self.condition:
            self.condition.wait_for(
                lambda: self.sent >= self.count or not self.clients, _SENDING_TIMEOUT
            )

    def encode(self, image: Image) -> bytes:
        """Return an image as a JPEG, spoilt as long as it is asked for."""
        jpeg, now = super().encode(image), time.monotonic()
        if now < self.halved:
            return jpeg[: len(jpeg) // 2]
        return _with_random_bytes(jpeg) if now < self.broken else jpeg

    def is_open(self) -> bool:
        """Return whether clients are served."""
        return time.monotonic() >= self.lost

    def end(self) -> None:
        """Serve nobody any more."""
        self.lost = np.inf


def _with_random_bytes(jpeg: bytes) -> bytes:
    rng, damaged = np.random.default_rng(), np.frombuffer(jpeg, np.uint8).copy()
    places = rng.integers(_JPEG_HEADER, len(jpeg) - 2, 20)
    damaged[places] = rng.integers(0, 256, 20)
    return damaged.tobytes()

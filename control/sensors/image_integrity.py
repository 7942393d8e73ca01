"""Integrity of an image: decoded without errors, whole, and new in all its parts."""

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import VideoReformatter

from touchgoal.control.arrays import Image

_STRICT = "explode+crccheck+bitstream+buffer"
_BANDS = 8  # bands of an image, checked for frozen parts
_STRIDE = 4  # pixels between those compared
_LEARNING = 20  # number of first images, which show the bands that sensor noise changes
_LIVELY = 0.8  # share of these images in which a band must change to be watched
# av 15, which lerobot 0.6 pins, has no argument `threads`.
_THREADS = {"threads": 1} if int(av.__version__.split(".")[0]) > 15 else {}


class JpegDecoder:
    """FFmpeg's decoder, set to refuse broken images instead of patching them."""

    def __init__(self) -> None:
        self._codec = av.CodecContext.create("mjpeg", "r")
        self._codec.options = {"err_detect": _STRICT}
        self._codec.thread_count = 1
        self._reformatter = VideoReformatter()  # a new one starts and ends a thread per core

    def decode(self, data: bytes) -> Image | None:
        """Return the RGB image; None if it is broken, for example cut off."""
        try:
            frames = self._codec.decode(av.Packet(data))
        except FFmpegError:
            return None
        if not frames or frames[0].is_corrupt:
            return None
        return self._reformatter.reformat(frames[0], format="rgb24", **_THREADS).to_ndarray()


class FrozenParts:
    """Detector of images, or bands of them, that stand still.

    Sensor noise changes every part of a real image; a band that never changes from the start
    (black, overexposed) is not watched.
    """

    def __init__(self) -> None:
        self._before: Image | None = None
        self._changes, self._seen = np.zeros(_BANDS), 0
        self._changed_at = np.zeros(_BANDS)

    def update(self, image: Image, now: float) -> float:
        """Return the time (s) since which a watched band is unchanged; `now` if none is."""
        before, self._before = self._before, image
        if before is None or before.shape != image.shape:
            self._changed_at[:] = now
            return now
        rows = (image[::_STRIDE, ::_STRIDE] != before[::_STRIDE, ::_STRIDE]).any(axis=(1, 2))
        changed = np.array([band.any() for band in np.array_split(rows, _BANDS)])
        self._changed_at[changed] = now
        if self._seen < _LEARNING:
            self._seen += 1
            self._changes += changed
        watched = self._changes >= _LIVELY * self._seen
        if self._seen < _LEARNING or not watched.any():
            return float(self._changed_at.max())  # all of it must stand still
        return float(self._changed_at[watched].min())

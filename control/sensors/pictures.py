"""Whether a picture is what the camera saw: decoded without errors, whole, and new in all its parts."""

import av
import cv2
import numpy as np
from av.error import FFmpegError
from jaxtyping import Bool, Int16, Int32, UInt8

Picture = UInt8[np.ndarray, "h w 3"]

_STRICT = "explode+crccheck+bitstream+buffer"
_BLOCK = 8  # px of JPEG
_JUMPS = 5  # the largest so many count: one block has four sides
_SMOOTH = (
    4.0  # counts; 47 presses of a real Mini stay below 1, nine in ten broken frames are above 7
)
_ALL_CHANNELS = np.ones((1, 3))  # their sum
_BANDS = 8  # that a picture is cut into to look for frozen parts
_STRIDE = 4  # pixels; every so many are compared
_LEARNING = 20  # pictures that tell which bands change all the time, as sensor noise makes them
_LIVELY = 0.8  # share of those in which they must


class JpegDecoder:
    """FFmpeg's, told to refuse what it would otherwise patch up."""

    def __init__(self) -> None:
        self._codec = av.CodecContext.create("mjpeg", "r")
        self._codec.options = {"err_detect": _STRICT}
        self._codec.thread_count = 1

    def decode(self, data: bytes) -> Picture | None:
        """RGB picture; None if anything about it is broken, such as a cut end."""
        try:
            frames = self._codec.decode(av.Packet(data))
        except FFmpegError:
            return None
        if not frames or frames[0].is_corrupt:
            return None
        return frames[0].to_ndarray(format="rgb24")


def jumps_at_blocks(image: Picture, before: Picture) -> float:
    """By how many counts the change since `before` jumps more between JPEG's blocks than inside them.

    A decoder cannot see every wrong byte. It shows as blocks of another brightness, which a smooth
    gel never has: its real changes do not know where blocks end.
    """
    change = cv2.transform(cv2.subtract(image, before, dtype=cv2.CV_16S), _ALL_CHANNELS)
    worst = 0.0
    for grey in (change, np.ascontiguousarray(change.T)):
        between, *inside = (_steps(grey, row) for row in (_BLOCK, 2, 4, 6))
        jump = _largest(between, _JUMPS) - _largest(np.concatenate(inside), 3 * _JUMPS)
        worst = max(worst, jump)
    return worst / (3 * _BLOCK)


def is_broken_gel(image: Picture, before: Picture) -> bool:
    """Whether a gel's picture came through a broken JPEG, judged by the last good one."""
    return jumps_at_blocks(image, before) > _SMOOTH


class FrozenParts:
    """Looks band by band for pictures, or parts of them, that stand still.

    Sensor noise makes every part of a real picture differ from the last; a band that does not do so
    from the start (black, overexposed) tells nothing and is not watched.
    """

    def __init__(self) -> None:
        self._before: Picture | None = None
        self._changes, self._seen = np.zeros(_BANDS), 0
        self._changed_at = np.zeros(_BANDS)

    def update(self, image: Picture, now: float) -> float:
        """Time (s) since when some watched part shows the same; `now` if none does."""
        before, self._before = self._before, image
        if before is None or before.shape != image.shape:
            self._changed_at[:] = now
            return now
        changed = _differs(image, before)
        self._changed_at[changed] = now
        if self._seen < _LEARNING:
            self._seen += 1
            self._changes += changed
        watched = self._changes >= _LIVELY * self._seen
        if self._seen < _LEARNING or not watched.any():
            return float(self._changed_at.max())  # all of it must stand still
        return float(self._changed_at[watched].min())


def _differs(image: Picture, before: Picture) -> Bool[np.ndarray, " bands"]:
    a, b = image[::_STRIDE, ::_STRIDE], before[::_STRIDE, ::_STRIDE]
    rows = (a != b).any(axis=(1, 2))
    return np.array([band.any() for band in np.array_split(rows, _BANDS)])


def _steps(grey: Int16[np.ndarray, "h w"], row: int) -> Int32[np.ndarray, " n"]:
    """From each block's row before `row` to that row, summed over the block's width."""
    before, after = grey[row - 1 : -1 : _BLOCK], grey[row::_BLOCK]
    steps = cv2.absdiff(np.ascontiguousarray(after), np.ascontiguousarray(before[: len(after)]))
    whole = steps.shape[1] // _BLOCK * _BLOCK
    return steps[:, :whole].reshape(-1, _BLOCK).sum(1, dtype=np.int32)


def _largest(values: Int32[np.ndarray, " n"], count: int) -> float:
    if not values.size:
        return 0.0
    return float(np.partition(values, -min(count, values.size))[-count:].mean())

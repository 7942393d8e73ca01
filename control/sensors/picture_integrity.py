"""Integrity of a picture: decoded without errors, whole, and new in all its parts."""

import av
import cv2
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import VideoReformatter
from jaxtyping import Bool, Float, Int16

from touchgoal.control.arrays import Picture

_STRICT = "explode+crccheck+bitstream+buffer"
_BLOCK = 8  # px of JPEG
_JUMPS = 5  # number of the largest jumps that are averaged: one block has four sides
_USUAL = 2.0  # ratio of the largest to the median jump in an intact, coarse JPEG
_SMOOTH = 3.5  # counts; real and simulated pictures at JPEG quality 75 and above stay below 3.4
_MEASURED = 5  # px of a block's side that must lie clear of dots for it to count
_DOT = 8.0  # px across, to which pictures with larger dots are scaled down to find them
_WIDER = 1.6  # width of the widest dark spot that counts as a dot, in dot diameters
_RIM = 0.25  # diameters around a dot that count as part of it
_DARKER = 0.12  # share of the usual brightness by which a dot is darker
_ALL_CHANNELS = np.ones((1, 3))  # their sum
_BANDS = 8  # bands of a picture, checked for frozen parts
_STRIDE = 4  # pixels between those compared
_LEARNING = 20  # number of first pictures, which show the bands that sensor noise changes
_LIVELY = 0.8  # share of these pictures in which a band must change to be watched
_Spotted = tuple[Picture, Bool[np.ndarray, "h w"] | None]  # a picture, and where its dots are
# av 15, which lerobot 0.6 pins, has no argument `threads`.
_THREADS = {"threads": 1} if int(av.__version__.split(".")[0]) > 15 else {}


class JpegDecoder:
    """FFmpeg's decoder, set to refuse broken pictures instead of patching them."""

    def __init__(self) -> None:
        self._codec = av.CodecContext.create("mjpeg", "r")
        self._codec.options = {"err_detect": _STRICT}
        self._codec.thread_count = 1
        self._reformatter = VideoReformatter()  # a new one starts and ends a thread per core

    def decode(self, data: bytes) -> Picture | None:
        """Return the RGB picture; None if it is broken, for example cut off."""
        try:
            frames = self._codec.decode(av.Packet(data))
        except FFmpegError:
            return None
        if not frames or frames[0].is_corrupt:
            return None
        return self._reformatter.reformat(frames[0], format="rgb24", **_THREADS).to_ndarray()


class BrokenBlocks:
    """Finds pictures of a gel from a damaged JPEG, by their change from the last good picture.

    A decoder cannot detect every wrong byte. A byte that it misses changes the brightness of whole
    JPEG blocks; real changes of a smooth gel do not stop at block borders, but for a straight edge that
    lies on one. It stays, and no two damages are alike: a picture that goes on from the one just refused
    is intact. Moving dots look like such blocks, so pixels near dots do not count; `dots` is their
    diameter as a share of the picture's diagonal, 0 without dots.
    """

    def __init__(self, dots: float) -> None:
        self._dots = dots
        self._intact: _Spotted | None = None
        self._refused: _Spotted | None = None  # the picture before, if that was refused

    def update(self, image: Picture) -> bool:
        """Return whether a picture is broken."""
        new = image, _dark_spots(image, self._dots) if self._dots > 0 else None
        before = [old for old in (self._intact, self._refused) if old is not None]
        if before and all(_change_at_blocks(new, old) > _SMOOTH for old in before):
            self._refused = new
            return True
        self._intact, self._refused = new, None
        return False


def _change_at_blocks(new: _Spotted, old: _Spotted) -> float:
    """Return by how much the change between two pictures jumps at block borders, counts."""
    change = cv2.subtract(new[0], old[0], dtype=cv2.CV_16S)
    clear = None if new[1] is None or old[1] is None else ~(new[1] | old[1])
    return _jumps_at_blocks(cv2.transform(change, _ALL_CHANNELS), clear)


def _jumps_at_blocks(
    change: Int16[np.ndarray, "h w"], clear: Bool[np.ndarray, "h w"] | None
) -> float:
    """Return by how much a change jumps more between JPEG blocks than within, counts."""
    worst = 0.0
    for turned in (False, True):
        grey = np.ascontiguousarray(change.T) if turned else change
        counts = clear.T if turned and clear is not None else clear
        between, *inside = (_steps(grey, counts, row) for row in (_BLOCK, 2, 4, 6))
        within = np.concatenate(inside)
        usual = _median(between) - _median(within)  # coarse JPEG lets every block show
        jump = _largest(between, _JUMPS) - _largest(within, 3 * _JUMPS) - _USUAL * usual
        worst = max(worst, jump)
    return worst / (3 * _BLOCK)


class FrozenParts:
    """Detector of pictures, or bands of them, that stand still.

    Sensor noise changes every part of a real picture; a band that never changes from the start
    (black, overexposed) is not watched.
    """

    def __init__(self) -> None:
        self._before: Picture | None = None
        self._changes, self._seen = np.zeros(_BANDS), 0
        self._changed_at = np.zeros(_BANDS)

    def update(self, image: Picture, now: float) -> float:
        """Return the time (s) since which a watched band is unchanged; `now` if none is."""
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


def _dark_spots(image: Picture, dots: float) -> Bool[np.ndarray, "h w"]:
    """Return spots darker than their surroundings and no larger than a dot, with rims."""
    height, width = image.shape[:2]
    diameter = dots * float(np.hypot(height, width))
    scale = min(1.0, _DOT / diameter)
    size = round(width * scale), round(height * scale)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    widest = int(_WIDER * diameter * scale) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (widest, widest))
    spots = cv2.morphologyEx(grey, cv2.MORPH_BLACKHAT, disc) > _DARKER * float(np.median(grey))
    rim = 2 * round(_RIM * diameter * scale) + 1
    spotted = cv2.dilate(spots.astype(np.uint8), np.ones((rim, rim), np.uint8))
    whole = cv2.resize(spotted, (width, height), interpolation=cv2.INTER_NEAREST)
    return whole.view(np.bool_)


def _steps(
    grey: Int16[np.ndarray, "h w"], counts: Bool[np.ndarray, "h w"] | None, row: int
) -> Float[np.ndarray, " n"]:
    """Return the steps to row `row` of each block from the row above, summed over its width.

    Partly covered blocks are scaled up, or left out if too little of them counts.
    """
    before, after = grey[row - 1 : -1 : _BLOCK], grey[row::_BLOCK]
    steps = cv2.absdiff(np.ascontiguousarray(after), np.ascontiguousarray(before[: len(after)]))
    whole = steps.shape[1] // _BLOCK * _BLOCK
    sides = steps[:, :whole].reshape(-1, _BLOCK)
    if counts is None:
        return sides.sum(1, dtype=np.float32)
    covered = (counts[row - 1 : -1 : _BLOCK] & counts[row::_BLOCK])[:, :whole].reshape(-1, _BLOCK)
    measured = covered.sum(1)
    enough = measured >= _MEASURED
    return (sides * covered).sum(1, dtype=np.float32)[enough] * _BLOCK / measured[enough]


def _largest(values: Float[np.ndarray, " n"], count: int) -> float:
    if not values.size:
        return 0.0
    return float(np.partition(values, -min(count, values.size))[-count:].mean())


def _median(values: Float[np.ndarray, " n"]) -> float:
    return float(np.median(values)) if values.size else 0.0

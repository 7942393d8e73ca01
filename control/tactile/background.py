"""Background of a sensor: its untouched image, followed as the light drifts."""

import sys
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.fft import dct

from touchgoal.control.arrays import AnyImage, Counts, Image, Images
from touchgoal.control.tactile.light_gain import GAIN_SPREAD, LARGE_CHANGE, divide_gain, light_gain
from touchgoal.runtime.errors import UserError

# Images are averaged over _CELL x _CELL pixels and then blurred. Measured on 320 x 240 frames:
# pixel noise of 1 count leaves at most 0.45 counts of `local_change`, and a bump of shading that
# falls off within 15 pixels (sigma 7.5) keeps half of its height.
_CELL = 4
_BLUR_CELLS = 1.5
# Cosines down and across the image that count as drift: a half wave of 60 px at 320 x 240, the
# smooth pattern by which a Mini differs from one day to the next (Tactile-MNIST).
_WAVES = 4, 5
_RATE = 0.02  # weight of a new frame: a time constant of 2 s at 25 Hz, slower than contacts
# Standard deviations between 150,000 real touches of Minis (Tactile-MNIST), counts.
_OFFSET_SPREAD, _PATTERN_SPREAD = 2.4, 2.4
_MOVED = 1.5  # counts of local change among the first frames, more than noise alone makes
_START = 5  # frames of which the untouched image is the median
_SAME_SHAPE = 5.0  # counts of local change, above the strongest compression noise: more is a touch
_JITTER = 1.0  # px by which a camera shakes; dots that move farther together are a touch

SETTLES_WITHIN = 15
"""First frames of a recording, in which its exposure may still settle."""


@dataclass(frozen=True)
class Drift:
    """Change of the light since the reference, by channel (R, G, B)."""

    gain: Float[np.ndarray, "3"]  # factor of the brightness, 1 for none
    offset: Float[np.ndarray, "3"]  # mean change beyond the gain's, counts
    pattern: Float[np.ndarray, "3"]  # largest smooth change beyond both, counts

    @property
    def large(self) -> bool:
        """Whether to take a new reference: more than twice the spread between real touches.

        The pattern's maximum over an image is already twice its standard deviation.
        """
        gain = np.abs(self.gain - 1) > LARGE_CHANGE
        offset = np.abs(self.offset) > 2 * _OFFSET_SPREAD
        return bool((gain | offset | (self.pattern > 4 * _PATTERN_SPREAD)).any())


class Background:
    """Untouched frame of one sensor as it is now; `update` follows its drift.

    It begins with the median of RGB frames of the untouched sensor, better five or more. UserError
    if the image changes between the frames.
    """

    def __init__(self, frames: Images) -> None:
        first = np.median(frames, axis=0).astype(np.float32)
        if max(float(local_change(frame, first).max()) for frame in frames) > _MOVED:
            raise UserError(
                "the touch sensor's image changes while its background is taken: "
                "keep it still and untouched, and start again"
            )
        self.steady, self._frames = first.copy(), len(frames)
        self._first, self._gain = first, np.ones(3, np.float32)

    @property
    def image(self) -> Counts:
        """Current background, counts."""
        return self.steady * self._gain

    def update(self, frame: Image) -> None:
        """Follow the drift by an untouched frame; the first 50 weigh the same."""
        self._frames += 1
        rate = max(_RATE, 1 / self._frames)
        gain = light_gain(frame, self._first)
        self._gain += rate * (gain - self._gain)
        cv2.accumulateWeighted(divide_gain(frame, gain), self.steady, rate)

    def drift(self, reference: Counts | None = None) -> Drift:
        """Return the drift from a reference, such as the sensor file's; None: the first frames."""
        reference = _blurred(self._first if reference is None else reference).reshape(-1, 3)
        change = _blurred(self.image).reshape(-1, 3) - reference
        gain, offset = np.empty(3), np.empty(3)
        for c in range(3):
            explain = np.stack([reference[:, c], np.ones(len(reference))], axis=1)
            # Gain and offset of a smooth background look alike: the spread decides between them.
            variance = len(explain) * _PATTERN_SPREAD**2 / (_WAVES[0] * _WAVES[1])
            normal = explain.T @ explain / variance + np.diag([GAIN_SPREAD**-2, _OFFSET_SPREAD**-2])
            gain[c], offset[c] = np.linalg.solve(normal, explain.T @ change[:, c] / variance)
        pattern = np.abs(change - gain * reference - offset).max(0)
        return Drift(1 + gain, offset, pattern.astype(np.float64))


def untouched_frames(frames: Images) -> UInt8[np.ndarray, "k h w 3"]:
    """Return the frames from which a recording's untouched image is taken, at least one.

    They are the first five in steady light (`first_steady`), fewer if a touch comes before.
    """
    first = first_steady(frames)
    found = frames[first : first + _START]
    strength = [float(local_change(frame, found[0]).max()) for frame in found]
    return found[: next((i for i, s in enumerate(strength) if s > _SAME_SHAPE), None)]


def first_steady(frames: Images, name: str = "") -> int:
    """Return the first frame after the exposure has settled; until then the light alone changes.

    It is looked for among the first 15 frames, if there are as many, and told on stderr if a `name`
    is given.
    """
    first = 0
    if len(frames) >= SETTLES_WITHIN:
        later = frames[SETTLES_WITHIN - 1]
        while first < SETTLES_WITHIN - _START and settling(frames[first], later):
            first += 1
    if first and name:
        left_out = f"frames 0 to {first - 1} are left out of the untouched image"
        print(f"{name}: {left_out}: the light of those after them differs", file=sys.stderr)
    return first


def settling(frame: Image, later: Image, least: float = LARGE_CHANGE) -> bool:
    """Return whether the light, and nothing else, differs from a later frame's by a share of `least`."""
    gain = light_gain(frame, later)
    if (np.abs(gain - 1) < least).all():
        return False
    return float(local_change(divide_gain(frame, gain), later).max()) < _SAME_SHAPE


def local_change(frame: AnyImage, background: AnyImage) -> Float32[np.ndarray, "H W"]:
    """Return the change from the background that neither light nor jitter explains, counts.

    Low spatial frequencies and a factor on the background are fitted to each channel of the blurred
    difference, and one shift of the whole image by up to a pixel to all of them. They are
    subtracted; what is left is its norm over the channels, at a quarter of the resolution.
    """
    reference = _blurred(background)
    change = _high_pass(_blurred(frame) - reference)
    structure = _high_pass(reference)
    energy = (structure**2).sum((0, 1)) + 1.0
    change -= (change * structure).sum((0, 1)) / energy * structure
    change -= _shifted(change, structure)
    return np.sqrt((change**2).sum(2))


def _shifted(
    change: Float32[np.ndarray, "H W 3"], structure: Float32[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "H W 3"]:
    """Return the part of a change that a small shift of the whole image explains."""
    kernel = np.array([[-0.5, 0, 0.5]], np.float32) / _CELL
    sides = [
        cv2.filter2D(structure, -1, k, borderType=cv2.BORDER_REPLICATE) for k in (kernel, kernel.T)
    ]
    slopes = np.stack([side.ravel() for side in sides])  # counts per px, along x and y
    normal = slopes @ slopes.T + np.eye(2, dtype=np.float32)
    shift = np.linalg.solve(normal, slopes @ change.ravel())
    shift *= min(1, _JITTER / max(float(np.hypot(*shift)), 1e-6))
    return (shift @ slopes).reshape(change.shape)


def _blurred(image: np.ndarray) -> Float32[np.ndarray, "H W 3"]:
    height, width, _ = image.shape
    size = max(width // _CELL, 1), max(height // _CELL, 1)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small.astype(np.float32), (0, 0), _BLUR_CELLS)


def _high_pass(image: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """Subtract the lowest cosines of an image."""
    height, width, channels = image.shape
    down, across = cosines(height, _WAVES[0]), cosines(width, _WAVES[1])
    waves = across @ (down @ image.reshape(height, -1)).reshape(-1, width, channels)
    smooth = down.T @ (across.T @ waves).reshape(len(down), -1)
    return image - smooth.reshape(image.shape)


@lru_cache
def cosines(size: int, count: int) -> Float32[np.ndarray, "k size"]:
    """Return the lowest waves of the cosine transform (type II), as orthonormal rows."""
    rows = np.asarray(dct(np.eye(size), axis=0, norm="ortho"), np.float32)[:count]
    rows.setflags(write=False)  # cached: all callers share it
    return rows

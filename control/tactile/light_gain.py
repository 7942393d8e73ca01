"""Light of a fingertip: its change since the untouched image, measured and taken out.

An LED that warms up, or a camera's exposure, multiplies each colour channel by a factor. Whatever
compares an image with an untouched one divides by that factor first, with `remove_gain`.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32

from touchgoal.control.arrays import AnyImage, Counts
from touchgoal.control.features import TACTILE, Observation

GAIN_SPREAD = 0.047
"""Standard deviation of a channel's brightness between 150,000 real touches of Minis (Tactile-MNIST)."""
LARGE_CHANGE = 2 * GAIN_SPREAD
"""Change of a channel's brightness beyond what training has shown, as a share."""
_ROWS = 32  # rows of cells in an image, at most; 30 x 40 cells at 240 x 320
_DARK, _BRIGHT = 16.0, 250.0  # counts below which noise matters, and above which pixels clip
_LEAST_CELLS = 0.05  # least share of usable cells for a channel's gain to be measured
_LEAST_GAIN = 0.04  # gain of an almost black image


def light_gain(image: AnyImage, untouched: AnyImage) -> Float32[np.ndarray, "3"]:
    """Return the factor of each channel's brightness between two RGB images of a fingertip.

    It is the median ratio over a grid of cells, so a contact of less than half the gel does not
    change it. Cells that are dark or clipped do not count; a channel without other cells has 1.
    """
    now, before = _cells(image), _cells(untouched)
    usable = (before > _DARK) & (before < _BRIGHT) & (now < _BRIGHT)
    ratios = now / np.maximum(before, 1)
    gain = np.ones(3, np.float32)
    for channel in range(3):
        ratio = ratios[channel, usable[channel]]
        if ratio.size >= _LEAST_CELLS * now.shape[1]:
            middle = ratio.size // 2
            gain[channel] = np.partition(ratio, middle)[middle]
    return np.maximum(gain, _LEAST_GAIN)


def remove_gain(image: AnyImage, untouched: AnyImage) -> Counts:
    """Return an image as it would look in the light of the untouched one, counts."""
    return divide_gain(image, light_gain(image, untouched))


def divide_gain(image: AnyImage, gain: Float32[np.ndarray, "3"]) -> Counts:
    """Return an image without a known gain."""
    rows, columns, _ = image.shape
    factors = np.tile(1 / gain, columns)  # whole rows at once: three times faster
    return (image.reshape(rows, -1) * factors).reshape(image.shape)


def _cells(image: AnyImage) -> Float32[np.ndarray, "3 n"]:
    """Return the means of each channel over parts of every n-th row: a grid of cells, as a list."""
    step = max(image.shape[0] // _ROWS, 1)
    rows = image[::step].astype(np.float32)
    size = max(image.shape[1] // step, 1), len(rows)
    return cv2.resize(rows, size, interpolation=cv2.INTER_AREA).reshape(-1, 3).T


class LightWatch:
    """Largest change of the fingertips' light since the first image of an episode.

    `change` is of the channel that changed most, as a share; -0.15 is 15 % dimmer.
    """

    def __init__(self) -> None:
        self.change = 0.0
        self._first: dict[str, AnyImage] = {}

    def update(self, observation: Observation) -> None:
        """Take the fingertips' images of an observation into account; the first are untouched."""
        for key in TACTILE:
            if key in observation:
                first = self._first.setdefault(key, observation[key])
                changes = light_gain(observation[key], first) - 1
                self.change = float(max(self.change, *changes, key=abs))


def light_advice(changes: Sequence[float]) -> str:
    """Say what a large change of the light means and what to do; empty if there is none.

    `changes` are the largest ones of each episode (`LightWatch.change`).
    """
    large = [change for change in changes if abs(change) > LARGE_CHANGE]
    if not large:
        return ""
    where = f" in {len(large)} of {len(changes)} episodes" if len(changes) > 1 else ""
    return (
        f"the fingertips' light changed by up to {max(large, key=abs):+.0%} after the first "
        f"image{where}; it is corrected, but sensors in training differ by {LARGE_CHANGE:.0%} at "
        "most: let the lamps warm up, fix exposure and white balance, and start again"
    )

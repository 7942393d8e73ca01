"""Images that carry a number, and waiting until something holds."""

import time
from collections.abc import Callable

import numpy as np

BITS = 12


def numbered(k: int, shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    """A reddish RGB image that carries `k` in black and white stripes."""
    image = np.full((*shape, 3), (180, 60, 20), np.uint8)
    for bit in range(BITS):
        image[:32, bit * 10 : bit * 10 + 10] = 255 * (k >> bit & 1)
    return image


def until(holds: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.01)

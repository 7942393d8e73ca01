"""One touch with a wand, simulated or real (MMWand)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

VIEW_SHAPE = (224, 224)
CLIP = 6  # tactile images of a touch: untouched, then at a rising force, last at the largest
FORCE_RANGES = ((0.0, 5.0), (5.0, 10.0), (10.0, 20.0))  # N, the paper's three
MAX_FORCE = 20.0  # N


@dataclass(frozen=True, eq=False)
class WandTouch:
    """One touch."""

    # before, views: view -> RGB, before contact and at contact
    before: dict[str, UInt8[np.ndarray, "H W 3"]]
    views: dict[str, UInt8[np.ndarray, "H W 3"]]
    clip: UInt8[np.ndarray, "t h w 3"]  # the sensor's images, RGB; the first is untouched
    load: Float32[np.ndarray, " t"]  # normal force at each image, N


def force_range(force: float) -> int:
    """Return which of the three ranges a force (N) lies in."""
    return int(np.searchsorted([high for _, high in FORCE_RANGES[:-1]], force))

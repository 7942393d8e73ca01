"""Wear of a gel, seen on its untouched image: torn, scratched or dirty.

The operator of MMWand looks at the gel after each press; here the image, corrected for light, is
compared with the gel's first one.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from touchgoal.control.arrays import Image
from touchgoal.control.tactile.background import local_change
from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.control.tactile.markers.tracker import without_dots
from touchgoal.control.tactile.sensor_models import SensorModel

# Strength of a change: counts, and multiple of the image's median. Between untouched images of one
# gel the strongest change in simulation is 1.0 counts and 3.9 times the median (single frames, light
# changed by 5 %). Of 408 pairs of real videos in a row (PhysiCLeAR, medians of 5 compressed frames) 22
# exceed both: dust and scratches that came between them, and the corners of the case.
_LEAST, _TIMES_USUAL = 2.5, 6.0
_BORDER = 16  # 1/n of each side is left out: there the case's edge shines
_SPOT = 0.4  # share of the strongest change above which adjacent pixels belong to the spot
_SLENDER = 2.2  # length over mean width of a scratch; a round spot has 1.3
_HOLE, _HOLE_WIDTH = 40.0, 1e-3  # counts, m: a dust grain is as strong, but small


@dataclass(frozen=True)
class GelWear:
    """Strongest change of a gel since its first image."""

    kind: Literal["torn", "scratched", "dirty"]  # what it looks like
    place: tuple[float, float]  # (x, y) of its middle from the image's top left corner, m
    length: float  # its longer side, m

    def __str__(self) -> str:
        x, y = (1e3 * side for side in self.place)
        remedy = (
            "wipe it clean, or put on a new gel" if self.kind == "dirty" else "put on a new gel"
        )
        return (
            f"the gel looks {self.kind}, {1e3 * self.length:.1f} mm long at {x:.0f} mm from the left and "
            f"{y:.0f} mm from the top of its image: {remedy}"
        )


def find_wear(untouched: Image, first: Image, sensor: SensorModel) -> GelWear | None:
    """Compare a gel's untouched RGB image with its first one; None if it has not changed.

    Dots are painted over. UserError if a gel with dots shows none.
    """
    now, before = (without_dots(image, sensor) for image in (untouched, first))
    change = local_change(remove_gain(now, before), before)
    rows, columns = change.shape
    inner = np.zeros_like(change)
    y, x = rows // _BORDER, columns // _BORDER
    inner[y : rows - y, x : columns - x] = change[y : rows - y, x : columns - x]
    peak = float(inner.max())
    if peak < max(_LEAST, _TIMES_USUAL * float(np.median(change))):
        return None
    _, labels = cv2.connectedComponents((inner > _SPOT * peak).astype(np.uint8))
    cells = np.argwhere(labels == labels[np.unravel_index(inner.argmax(), inner.shape)])
    cell = sensor.pixel_pitch * first.shape[0] / rows  # m
    (y, x), sides, _ = cv2.minAreaRect(cells.astype(np.float32))
    length, area = max(sides) + 1, len(cells)
    if peak > _HOLE and cell * area / length > _HOLE_WIDTH:
        kind = "torn"
    else:
        kind = "scratched" if length**2 > _SLENDER * area else "dirty"
    return GelWear(kind, ((x + 0.5) * cell, (y + 0.5) * cell), length * cell)

"""Surface of a gel under an object, and the shadows of its walls.

Heights are metres into the gel; x runs along the columns of an image, y down its rows.
"""

import math
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.arrays import Map

# Bulge and shadows are smooth: they are computed on cells of about this size, m. In metres, so that
# the result does not depend on the resolution.
CELL = 0.236e-3
SHADOW_CELLS = 16  # longest shadow, cells; on real presses 31 improve nothing

# The gel touches the object where the overlap exceeds this share of its maximum nearby; around that
# it has already come loose and bulges. Taxim's value; on real ball presses 0.3 to 0.4 fit best.
CONTACT_SHARE = 0.4
NEARBY_CELLS = 12  # 2.8 mm: farther maxima belong to another press, or a tilted edge's other end


def pixels_per_cell(pitch: float) -> int:
    """Return how many pixels of a pitch (m) make one side of a coarse cell: a power of two."""
    return 2 ** max(round(math.log2(CELL / pitch)), 0)


def deform(
    overlap: Map, pitch: float, blur_sigmas: tuple[float, ...], textured: bool = False
) -> Map:
    """Return the gel's surface (m) under an object's overlap (m, 0 without one) with the flat gel.

    The gel follows the object in contact and bulges smoothly around it: Taxim's contact-constrained
    pyramid, on coarse cells. (Box blurs would be faster, but their corners show as a cross around a
    small contact.) Full-resolution detail is added back inside the contact. `pitch` is m per pixel;
    `blur_sigmas` are the standard deviations of the pyramid, coarse to fine, m. `textured` says that
    detail as fine as a pixel counts; without, the result is smoothed, which fits real balls better.
    """
    h, w = overlap.shape
    scale = pixels_per_cell(pitch)
    low = cv2.resize(overlap, (w // scale, h // scale), interpolation=cv2.INTER_AREA)
    around = 2 * NEARBY_CELLS + 1
    nearby = cv2.dilate(low, np.ones((around, around), np.uint8))
    contact = (low > CONTACT_SHARE * nearby).view(np.uint8)  # 1 where the gel touches the object
    smooth = low
    for sigma in blur_sigmas:
        smooth = cv2.GaussianBlur(smooth, (0, 0), sigma / (pitch * scale))
        cv2.copyTo(low, contact, smooth)
    smooth = cv2.GaussianBlur(smooth, (5, 5), 0)  # the constraint's edge is no edge of the gel
    soft = cv2.GaussianBlur(contact.astype(np.float32), (5, 5), 0)
    smooth, low, soft = (
        cv2.resize(a, (w, h), interpolation=cv2.INTER_LINEAR) for a in (smooth, low, soft)
    )
    surface = smooth + soft * (overlap - low)
    return surface if textured else cv2.GaussianBlur(surface, (3, 3), 0)


def shadow_depth(
    surface: Map, pitch: float, azimuths: tuple[float, ...], slope: float
) -> Float32[np.ndarray, "lights h w"]:
    """Return how far (m) each point of a surface (m) lies below the shadow line of each light.

    Camera and lights look from inside the gel, so an indentation is a hill to them. A point is in
    shadow if the surface towards the light rises above the light's slope, the tangent of its height
    above the gel plane. `azimuths` are in degrees from the image's x towards y; `pitch` is m per
    pixel.
    """
    h, w = surface.shape
    scale = pixels_per_cell(pitch)
    low = cv2.resize(surface, (w // scale, h // scale), interpolation=cv2.INTER_AREA)
    rise = slope * pitch * scale
    # No shadow reaches farther; a surface that lies below rest all over throws none.
    longest = min(max(math.ceil(float(low.max()) / rise), 0), SHADOW_CELLS)
    shadows = np.empty((len(azimuths), h, w), np.float32)
    for shadow, azimuth in zip(shadows, azimuths, strict=True):
        # With the light's slope subtracted, the shadow line is a running maximum.
        tilted = low - _plane(azimuth, rise, low.shape)
        depth = cv2.dilate(tilted, _ray_mask(azimuth, longest)) - tilted
        cv2.resize(cv2.blur(depth, (3, 3)), (w, h), dst=shadow, interpolation=cv2.INTER_LINEAR)
    return shadows


@lru_cache(maxsize=256)  # a calibration calls it thousands of times
def _plane(azimuth: float, rise: float, shape: tuple[int, int]) -> Map:
    """Return a plane that climbs by `rise` each cell in a direction, degrees."""
    y, x = (rise * np.arange(n) for n in shape)
    angle = math.radians(azimuth)
    return np.add.outer(math.sin(angle) * y, math.cos(angle) * x).astype(np.float32)


@lru_cache(maxsize=256)
def _ray_mask(azimuth: float, reach: int) -> UInt8[np.ndarray, "k k"]:
    """Return a mask of the cells within reach of the middle one in a direction, degrees."""
    steps, angle = np.arange(reach + 1), math.radians(azimuth)
    y, x = (reach + np.rint(steps * f(angle)).astype(int) for f in (math.sin, math.cos))
    line = np.zeros((2 * reach + 1, 2 * reach + 1), np.uint8)
    line[y, x] = 1
    return line

"""From the shape pressed into a gel to what the sensor's camera sees.

A contact bulges the gel around it (`deform`), the coloured lights shade its slopes on the unit's
own background, and steep walls throw shadows (`render`). Heights are metres into the gel.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numba import njit

HeightField = Float32[np.ndarray, "h w"]

# Azimuth in the image (degrees, x right, y down) towards which the surface must lean for each
# channel to grow brightest, that is, where its light stands: the mean of two sources fitted to real Minis (gs_sdk's and gsrobotics' nets).
LIGHT_AZIMUTH_DEG = (81.0, -171.5, -96.0)
# Counts per unit of normal component, and per product of components (nx^2, ny^2, nx ny): the size
# of the response on real ball presses; `touchgoal calibrate` fits them to a unit.
_GAIN = (115.0, 88.0, 66.0)
_QUADRATIC = ((-20.0, 10.0, 5.0), (10.0, -15.0, 3.0), (-5.0, 12.0, 2.0))
_SHADOW_SLOPE = 0.9  # tangent of the lights' height above the gel plane
_SHADOW_STRENGTH = 1500.0  # darkening per m of shadow depth, at most one half
_NOISE_MARGIN = 64
# Standard deviations (m) of the gel's bulge, coarse to fine: Taxim's Gaussian pyramid.
_BULGE = (3.0e-3, 1.5e-3, 0.75e-3, 0.35e-3)


@dataclass(frozen=True)
class Unit:
    """One manufactured sensor: what differs between two of the same model.

    Attributes:
        background: the untouched frame, RGB in counts.
        gain: light response over the image per channel, about 1.
        noise: tile of camera noise in counts, larger than the image by 64 pixels.
    """

    background: Float32[np.ndarray, "3 h w"]
    gain: Float32[np.ndarray, "3 h w"]
    noise: Float32[np.ndarray, "3 h2 w2"]


def sample_unit(shape: tuple[int, int], rng: np.random.Generator) -> Unit:
    """A unit from the spread measured over real Minis (Tactile-MNIST: gain std 0.047, offset std
    0.0094 and smooth pattern std 0.0093 of full scale, noise std 0.97 counts)."""
    h, w = shape
    v, u = np.mgrid[0:h, 0:w].astype(np.float32) / np.array([h, w], np.float32).reshape(2, 1, 1)

    def glow(base: float, peak: float, x: float, y: float) -> np.ndarray:
        return base + peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) * 4)

    background = np.stack(
        [glow(85, 60, 0.5, 0.75), glow(100, 50, 0.2, 0.45), glow(95, 70, 0.55, 0.25)], -1
    )
    pattern = cv2.resize(rng.normal(0, 1, (4, 5, 3)), (w, h), interpolation=cv2.INTER_CUBIC)
    background = background * (1 + 0.047 * rng.normal(size=3))
    background += 255 * (0.0094 * rng.normal(size=3) + 0.0093 * pattern)
    gain = (0.75 + 0.5 * np.stack([v, 1 - u, 1 - v], -1)) * (1 + 0.05 * rng.normal(size=3))
    tile = (h + _NOISE_MARGIN, w + _NOISE_MARGIN, 3)
    noise = 0.97 * (0.6 * rng.normal(size=(*tile[:2], 1)) + 0.8 * rng.normal(size=tile))
    planar = (np.moveaxis(a, -1, 0) for a in (background, gain, noise))
    return Unit(*(np.ascontiguousarray(a, np.float32) for a in planar))


def deform(raw: HeightField, pitch: float) -> HeightField:
    """Surface of the gel under an object's overlap `raw` (m, 0 where there is none).

    The gel follows the object where they touch and bulges smoothly around it: Taxim's
    contact-constrained pyramid, at a quarter of the resolution. (Box blurs would be faster, but
    their corners show as a cross around a small contact.) The full-resolution detail, the texture,
    is added back inside the contact.
    """
    h, w = raw.shape
    scale = 4
    low = cv2.resize(raw, (w // scale, h // scale), interpolation=cv2.INTER_AREA)
    contact = low > 0.4 * float(low.max())
    smooth = low
    for sigma in _BULGE:
        blurred = cv2.GaussianBlur(smooth, (0, 0), sigma / (pitch * scale))
        smooth = np.where(contact, low, blurred)
    smooth = cv2.GaussianBlur(smooth, (5, 5), 0)  # the constraint's edge is no edge of the gel
    soft = cv2.GaussianBlur((low > 0).astype(np.float32), (5, 5), 0)
    smooth, low, soft = (
        cv2.resize(a, (w, h), interpolation=cv2.INTER_LINEAR) for a in (smooth, low, soft)
    )
    return cv2.GaussianBlur(smooth + soft * (raw - low), (3, 3), 0)


def _shadow_depth(surface: HeightField, pitch: float) -> Float32[np.ndarray, "3 h w"]:
    """How far (m) each point lies below the shadow line of each of the three lights.

    Camera and lights look from inside the gel, so what presses in is a hill to them. A point is in
    shadow if, going towards the light, the surface rises above the light's slope: the running
    maximum of height minus slope x distance, by doubling the distance five times.
    """
    h, w = surface.shape
    scale, steps = 2, 5
    low = cv2.resize(surface, (w // scale, h // scale), interpolation=cv2.INTER_AREA)
    shadows = np.empty((3, h, w), np.float32)
    for channel, azimuth in enumerate(np.radians(LIGHT_AZIMUTH_DEG)):
        ridge = low
        for k in range(steps):
            n = 1 << k
            drop = np.float32(n * pitch * scale * _SHADOW_SLOPE)
            here, there = _shifted(round(math.cos(azimuth) * n), round(math.sin(azimuth) * n))
            raised = ridge.copy()
            np.maximum(ridge[here], ridge[there] - drop, out=raised[here])
            ridge = raised
        depth = cv2.blur(ridge - low, (3, 3))
        cv2.resize(depth, (w, h), dst=shadows[channel], interpolation=cv2.INTER_LINEAR)
    return shadows


def _shifted(dx: int, dy: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Index pairs (p, p + (dx, dy)) of all pixels for which both lie in the image."""

    def pair(d: int) -> tuple[slice, slice]:
        return (slice(None, -d or None), slice(d, None)) if d >= 0 else (slice(-d, None), slice(d))

    (y, y_to), (x, x_to) = pair(dy), pair(dx)
    return (y, x), (y_to, x_to)


@njit(cache=True, fastmath=True)
@no_type_check
def _shade(surface, per_pitch, background, gain, response, shadow, noise, oy, ox, out):
    """All planar (channel, row, column), so that the inner loops vectorise."""
    h, w = surface.shape
    zero, half, one, full = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(255.0)
    scale = half * per_pitch
    nx, ny = np.empty(w, np.float32), np.empty(w, np.float32)
    for i in range(h):
        row, above, below = surface[i], surface[max(i - 1, 0)], surface[min(i + 1, h - 1)]
        for j in range(w):
            gx = (row[min(j + 1, w - 1)] - row[max(j - 1, 0)]) * scale
            gy = (below[j] - above[j]) * scale
            inverse = -one / math.sqrt(one + gx * gx + gy * gy)
            nx[j], ny[j] = gx * inverse, gy * inverse
        for c in range(3):
            a, b, aa, bb, ab = response[c]
            base, strength, dark = background[c, i], gain[c, i], shadow[c, i]
            grain, pixels = noise[c, i + oy, ox : ox + w], out[c, i]
            for j in range(w):
                x, y = nx[j], ny[j]
                light = a * x + b * y + aa * x * x + bb * y * y + ab * x * y
                left = one - min(max(dark[j] * np.float32(_SHADOW_STRENGTH), zero), half)
                value = (base[j] + strength[j] * light) * left + grain[j]
                pixels[j] = np.uint8(min(max(value, zero), full))


_AZIMUTH = np.radians(LIGHT_AZIMUTH_DEG)
_LINEAR = np.stack([np.cos(_AZIMUTH), np.sin(_AZIMUTH)], -1) * np.array(_GAIN)[:, None]
_RESPONSE = np.hstack([_LINEAR, _QUADRATIC]).astype(np.float32)  # per channel: x, y, xx, yy, xy


def render(
    surface: HeightField, pitch: float, unit: Unit, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """RGB frame of a gel surface; `rng` picks which part of the noise tile this frame gets."""
    oy, ox = rng.integers(0, _NOISE_MARGIN, 2)
    out = np.empty((3, *surface.shape), np.uint8)
    _shade(
        surface,
        np.float32(1.0 / pitch),
        unit.background,
        unit.gain,
        _RESPONSE,
        _shadow_depth(surface, pitch),
        unit.noise,
        oy,
        ox,
        out,
    )
    return cv2.merge([out[0], out[1], out[2]])


def render_untouched(unit: Unit, rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """RGB frame of a gel that nothing touches: background and noise alone."""
    oy, ox = rng.integers(0, _NOISE_MARGIN, 2)
    _, h, w = unit.background.shape
    frame = unit.background + unit.noise[:, oy : oy + h, ox : ox + w]
    red, green, blue = np.clip(frame, 0, 255).astype(np.uint8)
    return cv2.merge([red, green, blue])

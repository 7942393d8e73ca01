"""How a gel's surface follows what presses into it, and where its walls throw shadows.

Heights are metres into the gel; x runs along the columns of an image, y down its rows.
"""

import math

import cv2
import numpy as np
from jaxtyping import Float32

HeightField = Float32[np.ndarray, "h w"]


def deform(raw: HeightField, pitch: float, bulge: tuple[float, ...]) -> HeightField:
    """Surface of the gel under an object's overlap `raw` (m, 0 where there is none).

    The gel follows the object where they touch and bulges smoothly around it: Taxim's
    contact-constrained pyramid, at a quarter of the resolution. (Box blurs would be faster, but
    their corners show as a cross around a small contact.) The full-resolution detail, the texture,
    is added back inside the contact.

    Args:
        pitch: m per pixel.
        bulge: standard deviations of the pyramid, coarse to fine, m.
    """
    h, w = raw.shape
    scale = 4
    low = cv2.resize(raw, (w // scale, h // scale), interpolation=cv2.INTER_AREA)
    contact = low > 0.4 * float(low.max())
    smooth = low
    for sigma in bulge:
        blurred = cv2.GaussianBlur(smooth, (0, 0), sigma / (pitch * scale))
        smooth = np.where(contact, low, blurred)
    smooth = cv2.GaussianBlur(smooth, (5, 5), 0)  # the constraint's edge is no edge of the gel
    soft = cv2.GaussianBlur((low > 0).astype(np.float32), (5, 5), 0)
    smooth, low, soft = (
        cv2.resize(a, (w, h), interpolation=cv2.INTER_LINEAR) for a in (smooth, low, soft)
    )
    return cv2.GaussianBlur(smooth + soft * (raw - low), (3, 3), 0)


def shadow_depth(
    surface: HeightField, pitch: float, azimuths: tuple[float, ...], slope: float
) -> Float32[np.ndarray, "lights h w"]:
    """How far (m) each point lies below the shadow line of each light.

    Camera and lights look from inside the gel, so what presses in is a hill to them. A point is in
    shadow if, going towards the light, the surface rises above the light's slope: the running
    maximum of height minus slope x distance, by doubling the distance five times.

    Args:
        azimuths: where in the image each light stands, degrees from x towards y.
        slope: tangent of the lights' height above the gel plane.
    """
    h, w = surface.shape
    scale, steps = 2, 5
    low = cv2.resize(surface, (w // scale, h // scale), interpolation=cv2.INTER_AREA)
    shadows = np.empty((len(azimuths), h, w), np.float32)
    for light, azimuth in enumerate(np.radians(azimuths)):
        ridge = low
        for k in range(steps):
            n = 1 << k
            drop = np.float32(n * pitch * scale * slope)
            here, there = _shifted(round(math.cos(azimuth) * n), round(math.sin(azimuth) * n))
            raised = ridge.copy()
            np.maximum(ridge[here], ridge[there] - drop, out=raised[here])
            ridge = raised
        depth = cv2.blur(ridge - low, (3, 3))
        cv2.resize(depth, (w, h), dst=shadows[light], interpolation=cv2.INTER_LINEAR)
    return shadows


def _shifted(dx: int, dy: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Index pairs (p, p + (dx, dy)) of all pixels for which both lie in the image."""

    def pair(d: int) -> tuple[slice, slice]:
        return (slice(None, -d or None), slice(d, None)) if d >= 0 else (slice(-d, None), slice(d))

    (y, y_to), (x, x_to) = pair(dy), pair(dx)
    return (y, x), (y_to, x_to)

"""What the coloured lights inside a sensor make of the shape of its gel: the sensor file."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

N_FEATURES = 9


@dataclass(frozen=True)
class Photometry:
    """One sensor's colours, as `touchgoal calibrate` fits them to presses.

    Attributes:
        background: the untouched sensor, RGB.
        pixel_pitch: m per pixel.
        response: counts per channel and feature of the surface normal (`features`); the last axis
            multiplies (1, u, v), where u and v run from -1 to 1 across columns and rows.
        light_azimuths: where in the image each light stands, degrees from x (right) towards y
            (down).
        shadow_slope: tangent of the lights' height above the gel plane.
        shadow: counts per channel and m of each light's shadow depth (`gel.shadow_depth`).
        bulge: standard deviations of the gel's bulge, coarse to fine, m (`gel.deform`).
        noise: standard deviation of the camera's noise, counts.
    """

    background: UInt8[np.ndarray, "h w 3"]
    pixel_pitch: float
    response: Float32[np.ndarray, "3 9 3"]
    light_azimuths: tuple[float, ...]
    shadow_slope: float
    shadow: Float32[np.ndarray, "3 lights"]
    bulge: tuple[float, ...]
    noise: float


def features(
    gx: Float[np.ndarray, "h w"], gy: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "9 h w"]:
    """Monomials of the surface normal that the colours are linear in.

    Args:
        gx, gy: slopes of the surface (m into the gel per m along x and y).

    Returns:
        nx, ny, nx^2, nx ny, ny^2, nx^3, nx^2 ny, nx ny^2, ny^3 of the unit normal's components in
        the image plane, (nx, ny) = -(gx, gy) / sqrt(1 + gx^2 + gy^2).
    """
    inverse = -1 / np.sqrt(1 + gx * gx + gy * gy)
    x, y = gx * inverse, gy * inverse
    return np.stack([x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])

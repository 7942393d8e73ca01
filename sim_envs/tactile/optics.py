"""Colours of a gel's surface (heights in m into the gel) in the sensor's camera.

They are computed at the surface's resolution, the image's or half of it, which is enough where
nothing is finely structured, and blended onto background and noise.
"""

from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numba import njit

from touchgoal.control.tactile.sensor_calibration import calibrated_shadow_depth
from touchgoal.sim_envs.tactile.sensor_instance import COUNT_STEP, NOISE_MARGIN, SensorInstance

HeightField = Float32[np.ndarray, "h w"]


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _response(x, y, depth, k):
    """Evaluate the response to a normal and a depth (`sensor_calibration.shape_features`)."""
    along = k[0] + x * (k[2] + k[5] * x + k[6] * y) + y * (k[3] + k[7] * y)
    return x * along + y * (k[1] + y * (k[4] + k[8] * y)) + k[9] * depth


@njit(inline="always")
@no_type_check
def _along(k, slope, v):
    """Return a channel's coefficients at height v, as a tuple: an array might alias the output."""
    return (
        k[0] + v * slope[0],
        k[1] + v * slope[1],
        k[2] + v * slope[2],
        k[3] + v * slope[3],
        k[4] + v * slope[4],
        k[5] + v * slope[5],
        k[6] + v * slope[6],
        k[7] + v * slope[7],
        k[8] + v * slope[8],
        k[9] + v * slope[9],
    )


@njit(cache=True, fastmath=True, error_model="numpy")
@no_type_check
def _colours(surface, step, per_pitch, response, limits, depths, penumbra, shadow, gain, out):
    """Compute `sensor_calibration.shade` less the background, planar, on every `step`th pixel."""
    h, w = surface.shape
    half, one, zero = np.float32(0.5), np.float32(1.0), np.float32(0.0)
    finer = 2 - step  # light and shadows are at half the image's resolution
    start = step - 1.0
    across = ((2.0 * step * np.arange(w) + start) / (step * w - 1) - 1.0).astype(np.float32)
    scale = half * per_pitch
    max_slope, max_depth = limits
    flattest = one / (max_slope * max_slope)
    squares, down = response.shape[2] > 3, np.empty(10, np.float32)
    nx, ny, pressed = np.empty(w, np.float32), np.empty(w, np.float32), np.empty(w, np.float32)
    lights, darks = np.empty((3, w), np.float32), np.empty((3, w), np.float32)
    wide = np.empty(w + 2, np.float32)
    left, right = wide[:w], wide[2:]
    for i in range(h):
        row, above, below = surface[i], surface[max(i - 1, 0)], surface[min(i + 1, h - 1)]
        wide[1 : w + 1] = row
        wide[0], wide[w + 1] = row[0], row[w - 1]
        for j in range(w):
            gx = (right[j] - left[j]) * scale
            gy = (below[j] - above[j]) * scale
            square = gx * gx + gy * gy
            inverse = -one / np.sqrt(max(one + square, square * flattest))
            nx[j], ny[j] = gx * inverse, gy * inverse
            pressed[j] = min(row[j], max_depth)
        v = np.float32((2.0 * step * i + start) / (step * h - 1) - 1)
        if not (finer and i & 1):
            _light_row(depths, gain, i >> finer, penumbra, shadow, finer, lights, darks)
        for c in range(3):
            for k in range(10):
                down[k] = response[c, k, 2]
                if squares:
                    down[k] += v * response[c, k, 4]
            a = _along(response[c, :, 0], down, v)
            b = _along(response[c, :, 1], response[c, :, 1], zero)
            light, dark, change = lights[c], darks[c], out[c, i]
            for j in range(w):
                x, y, z, u = nx[j], ny[j], pressed[j], across[j]
                lit = _response(x, y, z, a) + u * _response(x, y, z, b)
                change[j] = light[j] * lit + dark[j]
            if squares:
                b = _along(response[c, :, 3], response[c, :, 3], zero)
                for j in range(w):
                    u = across[j]
                    change[j] += light[j] * u * u * _response(nx[j], ny[j], pressed[j], b)


@njit(inline="always", fastmath=True, error_model="numpy")
@no_type_check
def _light_row(depths, gain, k, penumbra, shadow, finer, lights, darks):
    """Write the light of row k, and what shadows add to it, for each channel; doubled if `finer`."""
    w = gain.shape[2]
    z0, z1, z2 = depths[0, k], depths[1, k], depths[2, k]
    for c in range(3):
        s0, s1, s2 = shadow[c, 0], shadow[c, 1], shadow[c, 2]
        light, dark, glow = lights[c], darks[c], gain[c, k]
        for j in range(w):
            a, b, d = z0[j], z1[j], z2[j]
            dim = s0 * a / (a + penumbra) + s1 * b / (b + penumbra) + s2 * d / (d + penumbra)
            dark[j] = glow[j] * dim
        if not finer:
            light[:] = glow
            continue
        for j in range(w - 1, -1, -1):
            dark[2 * j] = dark[2 * j + 1] = dark[j]
            light[2 * j] = light[2 * j + 1] = glow[j]


def colour_change(surface: HeightField, instance: SensorInstance) -> Float32[np.ndarray, "3 h w"]:
    """Return the colours (counts) that a surface adds to the untouched image, at its resolution."""
    calibration, step = instance.calibration, instance.background.shape[1] // len(surface)
    pitch = step * instance.pixel_pitch
    change = np.empty((3, *surface.shape), np.float32)
    h, w = instance.illumination.shape[1:]
    smooth = cv2.resize(surface, (w, h), interpolation=cv2.INTER_AREA)  # shadows are
    limits = calibration.max_slope, calibration.max_depth
    _colours(
        surface,
        step,
        np.float32(1 / pitch),
        calibration.response,
        tuple(np.float32(a) for a in limits),
        calibrated_shadow_depth(calibration, smooth, 2 * instance.pixel_pitch),
        np.float32(calibration.penumbra),
        calibration.shadow,
        instance.illumination,
        change,
    )
    if instance.defocus:
        sigma = instance.defocus / step
        return np.stack([cv2.GaussianBlur(change[c], (0, 0), sigma) for c in range(3)])
    return change


@njit(cache=True, fastmath=True, error_model="numpy")
@no_type_check
def _blend(change, background, noise, oy, ox, out):
    """Double a half-size change bilinearly, add background and noise, clip to bytes, RGB in turn."""
    _, h, w = change.shape
    rows, columns = background.shape[1:]
    near, far = np.float32(0.75), np.float32(0.25)
    zero, half, full = np.float32(0.0), np.float32(0.5), np.float32(255.0)
    step = np.float32(COUNT_STEP)
    coarse, fine = np.empty(w + 2, np.float32), np.empty(columns, np.float32)
    planes = np.empty((3, columns), np.uint8)
    red, green, blue = planes[0], planes[1], planes[2]
    for i in range(rows):
        k = i >> 1
        beside = min(max(k + (1 if i & 1 else -1), 0), h - 1)
        for c in range(3):
            if h == rows:
                fine[:] = change[c, i]
            else:
                a, b = change[c, k], change[c, beside]
                for j in range(w):
                    coarse[j + 1] = near * a[j] + far * b[j]
                coarse[0], coarse[w + 1] = coarse[1], coarse[w]
                for j in range(w):
                    fine[2 * j] = near * coarse[j + 1] + far * coarse[j]
                    fine[2 * j + 1] = near * coarse[j + 1] + far * coarse[j + 2]
            base, grain = background[c, i], noise[c, i + oy, ox : ox + columns]
            pixels = planes[c]
            for j in range(columns):
                value = half + fine[j] + step * (np.float32(base[j]) + np.float32(grain[j]))
                pixels[j] = np.uint8(min(max(value, zero), full))
        row = out[i]
        for j in range(columns):
            row[3 * j], row[3 * j + 1], row[3 * j + 2] = red[j], green[j], blue[j]


def _frame(
    change: Float32[np.ndarray, "3 h w"], instance: SensorInstance, rng: np.random.Generator
) -> UInt8[np.ndarray, "h2 w2 3"]:
    oy, ox = rng.integers(0, NOISE_MARGIN, 2)
    _, h, w = instance.background.shape
    image = np.empty((h, 3 * w), np.uint8)
    _blend(change, instance.background, instance.noise, oy, ox, image)
    return image.reshape(h, w, 3)


def render(
    surface: HeightField, instance: SensorInstance, rng: np.random.Generator
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Render the RGB frame of a surface of its resolution or half of it; `rng` shifts the noise."""
    return _frame(colour_change(surface, instance), instance, rng)


def render_untouched(
    instance: SensorInstance, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Render the RGB frame of an untouched gel: background and noise."""
    return _frame(np.zeros_like(instance.illumination), instance, rng)

"""Sensor file: colours that the lights inside a sensor give to the shape of its gel.

A gel surface h(x, y), m into the gel (`gel.deform`), has slopes gx = dh/dx, gy = dh/dy by central
differences and the unit normal's image-plane part (nx, ny) = -(gx, gy) / sqrt(1 + gx^2 + gy^2).
With the ten features f_k of `shape_features`, position p = (1, u, v) or (1, u, v, u^2, v^2), u and v
from -1 to 1 across columns and rows, and shadow depths s_l of `gel.shadow_depth`, channel c shows

    I_c = background_c + noise + gain_c (
        sum over k, m of response[c,k,m] f_k p_m
        + sum over l of shadow[c,l] s_l / (s_l + penumbra)
    )

The gain is the blurred background divided by its mean, to the power `illumination_exponent`: where
little light falls, slopes change the image little. (A real Mini fits 2, not 1: scattered light
fills the background where the lamps do not reach; with 1 its balls read up to 40 % too flat in the
corners.) The polynomial holds only within the presses: a normal steeper than `max_slope` is
shortened to it, a depth beyond `max_depth` counts as `max_depth`.
"""

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from touchgoal.control.arrays import Counts, Image, Map
from touchgoal.control.tactile import gel
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image, write_image

N_FEATURES = 10
PLACES = {2: 3, 3: 5}
"""Position terms by the format of the sensor file: 1, u and v; from 3 on their squares, too."""
_JSON, _BACKGROUND = "sensor.json", "background.png"
_MAKE = "make one with: touchgoal calibrate PRESSES"


@dataclass(frozen=True)
class SensorCalibration:
    """Colours of one sensor, as `touchgoal calibrate` fits them to presses: the sensor file."""

    sensor: str  # name of the sensor model
    background: Image  # the untouched sensor, RGB
    pixel_pitch: float  # m per pixel
    # counts per channel and feature (`shape_features`); the last axis multiplies `position_terms`
    response: Float32[np.ndarray, "3 10 places"]
    light_azimuths: tuple[float, ...]  # of the lights, degrees from image x (right) to y (down)
    shadow_slope: float  # tangent of the lights' height above the gel plane
    shadow: Float32[np.ndarray, "3 lights"]  # counts in each light's deepest shadow
    penumbra: float  # shadow depth (`gel.shadow_depth`) of a half-shadow, m
    # max_slope, max_depth: largest length of (nx, ny), and depth in m, in the presses
    max_slope: float
    max_depth: float
    blur_sigmas: tuple[float, ...]  # of the gel's bulge, coarse to fine, m (`gel.deform`)
    noise: float  # standard deviation of the camera's noise, counts
    # power of the background's brightness by which the response varies (`illumination`)
    illumination_exponent: float = 1.0


def illumination(background: Image, illumination_exponent: float = 1.0) -> Counts:
    """Return the strength of the response over the image, per channel relative to the mean."""
    light = cv2.GaussianBlur(background.astype(np.float32), (0, 0), background.shape[1] / 40)
    light = (light / light.mean((0, 1))) ** np.float32(illumination_exponent)
    return light / light.mean((0, 1))


def position_terms(
    u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."], n: int
) -> Float[np.ndarray, "places ..."]:
    """Return the first `n` of 1, u, v, u^2, v^2; u and v run from -1 to 1 across columns and rows."""
    terms = np.broadcast_arrays(np.ones_like(u), u, v, u * u, v * v)
    return np.stack(terms[:n])


def shape_features(
    surface: Map, pitch: float, max_slope: float, max_depth: float
) -> Float32[np.ndarray, "10 h w"]:
    """Return the ten features of a surface (m into the gel) that the colours are linear in.

    Returns nx, ny, nx^2, nx ny, ny^2, nx^3, nx^2 ny, nx ny^2, ny^3 of the unit normal's components
    in the image plane (at most `max_slope` long), and the depth in m.
    """
    padded = np.pad(surface, 1, mode="edge")
    gx = (padded[1:-1, 2:] - padded[1:-1, :-2]) * np.float32(0.5 / pitch)
    gy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) * np.float32(0.5 / pitch)
    square = gx * gx + gy * gy  # |n| = s / sqrt(1 + s^2) for slope s; at most `max_slope`
    inverse = -1 / np.sqrt(np.maximum(1 + square, square / np.float32(max_slope**2)))
    depth = np.minimum(surface, np.float32(max_depth))
    return np.stack([*monomials(gx * inverse, gy * inverse), depth])


def monomials(
    x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "9 ..."]:
    """Return x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3 of a normal in the image plane."""
    xx, xy, yy = x * x, x * y, y * y
    return np.stack([x, y, xx, xy, yy, xx * x, xx * y, x * yy, yy * y])


def calibrated_shadow_depth(
    calibration: SensorCalibration, surface: Map, pitch: float
) -> Float32[np.ndarray, "lights h w"]:
    """Return `gel.shadow_depth` (m) of a surface (m) of a pitch (m/px) for a sensor's lights.

    A depth beyond `max_depth` counts as `max_depth`.
    """
    _, known = cv2.threshold(surface, calibration.max_depth, 0, cv2.THRESH_TRUNC)
    return gel.shadow_depth(known, pitch, calibration.light_azimuths, calibration.shadow_slope)


def shadows(
    calibration: SensorCalibration, surface: Map, pitch: float
) -> Float32[np.ndarray, "lights h w"]:
    """Return the share of each light's full shadow, 0 to 1, on a surface (m) of a pitch (m/px)."""
    depth = calibrated_shadow_depth(calibration, surface, pitch)
    return depth / (depth + np.float32(calibration.penumbra))


def design_matrix(
    calibration: SensorCalibration, surface: Map, pixels: Int[np.ndarray, " n"]
) -> Float32[np.ndarray, "terms n"]:
    """Return the terms of the colour change at pixels (flat indices) of a gel's surface (m).

    They are the features times each of `position_terms`, then the shadows; of the sensor file only
    the non-linear parameters and the number of position terms are used.
    """
    h, w = surface.shape
    shape = shape_features(
        surface, calibration.pixel_pitch, calibration.max_slope, calibration.max_depth
    )
    shape = shape.reshape(N_FEATURES, -1)[:, pixels]
    v, u = np.divmod(pixels, w) * (2 / np.array([[h - 1], [w - 1]], np.float32)) - 1
    dark = shadows(calibration, surface, calibration.pixel_pitch).reshape(-1, h * w)[:, pixels]
    places = position_terms(u, v, calibration.response.shape[2])
    terms = np.concatenate([*(shape * place for place in places), dark])
    return terms.astype(np.float32, copy=False)


def coefficients(calibration: SensorCalibration) -> Float32[np.ndarray, "3 terms"]:
    """Return the weight of each term of `design_matrix`, per channel."""
    response = calibration.response.transpose(0, 2, 1).reshape(3, -1)
    return np.concatenate([response, calibration.shadow], 1)


def shade(calibration: SensorCalibration, surface: Map) -> Counts:
    """Render a gel surface (m) without noise: RGB counts, neither rounded nor clipped.

    This is the reference; the simulator's fused kernels must agree with it.
    """
    terms = design_matrix(calibration, surface, np.arange(surface.size))
    change = (coefficients(calibration) @ terms).T.reshape(*surface.shape, 3)
    gain = illumination(calibration.background, calibration.illumination_exponent)
    return calibration.background + gain * change


def save(calibration: SensorCalibration, folder: Path, provenance: dict[str, Any]) -> None:
    """Write `sensor.json` and `background.png`, replacing an older sensor file there.

    `provenance` (JSON-able) says source, command, presses and held-out errors.
    """
    rows, columns, _ = calibration.background.shape
    numbers = {name: _plain(getattr(calibration, name)) for name in _NUMBERS}
    version = next(n for n, places in PLACES.items() if places == calibration.response.shape[2])
    description = {"format": version, "image_shape": [rows, columns], **numbers}
    text = json.dumps({**description, "provenance": provenance}, indent=1)
    write_image(folder / _BACKGROUND, calibration.background)
    one_line_lists = _INNERMOST.sub(lambda m: " ".join(m[0].split()), text)
    write_file(folder / _JSON, f"{one_line_lists}\n".encode())


def load(folder: Path) -> SensorCalibration:
    """Read the sensor file of a folder; UserError if missing, damaged, or of another format."""
    path = folder / _JSON
    if not path.is_file():
        raise UserError(f"no sensor file in {folder}: {_MAKE}")
    try:
        description = json.loads(path.read_text())
        version = description["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f"{path} is no sensor file: {_MAKE}") from error
    if version not in PLACES:
        known = " and ".join(map(str, PLACES))
        raise UserError(f"{path} has format {version}, this touchgoal reads {known}: {_MAKE}")
    image = read_image(folder / _BACKGROUND)
    if image is None:
        raise UserError(f"{folder / _BACKGROUND} is missing or no image: {_MAKE}")
    if list(image.shape[:2]) != description.get("image_shape"):
        raise UserError(
            f"{folder / _BACKGROUND} has {image.shape[:2]} rows and columns, {path} says "
            f"{description.get('image_shape')}: they belong to different sensor files; {_MAKE}"
        )
    values: dict[str, Any] = {}
    for name, kind in _NUMBERS.items():
        try:
            values[name] = kind(description[name])
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path} has no usable {name} ({error}): {_MAKE}") from error
    lights = len(values["light_azimuths"])
    shapes = {"response": (3, N_FEATURES, PLACES[version]), "shadow": (3, lights)}
    for name, shape in shapes.items():
        if values[name].shape != shape:
            raise UserError(f"{path}: {name} is {values[name].shape}, not {shape}: {_MAKE}")
    return SensorCalibration(background=image, **values)


def _array(value: Any) -> Float32[np.ndarray, "..."]:
    array = np.array(value, np.float32)
    if not np.isfinite(array).all():
        raise ValueError("not finite")
    return array


def _positive(value: Any) -> float:
    if not (value > 0 and math.isfinite(value)):
        raise ValueError(f"must be positive, not {value}")
    return float(value)


def _plain(value: Any) -> Any:
    """Return a JSON-able value with seven digits."""
    if isinstance(value, np.ndarray | tuple):
        return [_plain(v) for v in value]
    return value if isinstance(value, str) else float(f"{value:.7g}")


# Values of sensor.json besides the shape of the background, and how each is read.
_NUMBERS: dict[str, Callable[[Any], Any]] = {
    "sensor": str,
    "pixel_pitch": _positive,
    "response": _array,
    "light_azimuths": lambda value: tuple(map(float, _array(value))),
    "shadow_slope": _positive,
    "shadow": _array,
    "penumbra": _positive,
    "max_slope": _positive,
    "max_depth": _positive,
    "blur_sigmas": lambda value: tuple(map(float, _array(value))),
    "noise": lambda value: float(value) if math.isfinite(value) else math.nan,
    "illumination_exponent": _positive,
}
_INNERMOST = re.compile(r"\[[^\[\]{}]*\]")  # lists of numbers go on one line

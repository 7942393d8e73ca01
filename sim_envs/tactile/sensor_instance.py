"""Differences between two sensors of one model."""

import math
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8, Int16, UInt8

from touchgoal.control.tactile.sensor_calibration import (
    SensorCalibration,
    illumination,
    load,
    monomials,
)
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.sim_envs.config import SensorRandomization
from touchgoal.sim_envs.tactile.markers import draw, rest_positions

NOISE_MARGIN = 64  # px by which the noise tile is larger than a frame
COUNT_STEP = 1 / 16  # counts: fine enough, and small enough numbers for the processor's cache
_SHARED, _OWN = math.sqrt(0.3), math.sqrt(0.7)  # of the noise, by all channels and by one


@dataclass(frozen=True)
class SensorInstance:
    """One simulated sensor: its sensor file, varied as two of a model differ."""

    calibration: SensorCalibration
    background: Int16[np.ndarray, "3 h w"]  # the untouched frame, RGB in units of COUNT_STEP
    illumination: Float32[np.ndarray, "3 h3 w3"]  # light by channel, half size; instances share it
    # camera noise in units of COUNT_STEP, on a tile larger than the frame by NOISE_MARGIN
    noise: Int8[np.ndarray, "3 h2 w2"]
    markers: Float32[np.ndarray, "n 2"]  # resting dots (x, y), px; none on a plain gel
    marker_radius: float  # px
    defocus: float = 0.0  # standard deviation of the camera's blur by its lens, px

    @property
    def pixel_pitch(self) -> float:
        """m per pixel."""
        return self.calibration.pixel_pitch

    def with_dots(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Draw the resting dots into an image, in place, and return it."""
        draw(image, self.markers, self.marker_radius)
        return image


def sample_instance(
    sensor: SensorModel, rng: np.random.Generator, randomization: SensorRandomization | None = None
) -> SensorInstance:
    """Draw one sensor of a model: its sensor file, varied by the randomization.

    UserError: the model's sensor file is missing or damaged.
    """
    randomization = randomization or SensorRandomization()
    typical, light = _typical(sensor)
    brightness = 1 + randomization.gain * rng.normal(size=3)
    turns = randomization.azimuth * rng.uniform(-1, 1, 3)
    blur_sigmas = tuple(
        b * (1 + randomization.blur * rng.uniform(-1, 1)) for b in typical.blur_sigmas
    )
    pitch = rng.uniform(*sensor.pitch_range) if randomization.pixel_pitch else sensor.pixel_pitch
    azimuths = np.array(typical.light_azimuths) + turns
    channels = brightness.astype(np.float32)[:, None]
    calibration = replace(
        typical,
        pixel_pitch=pitch,
        response=_turned(typical.response, np.radians(turns)) * channels[..., None],
        # Light l lights channel l: its shadows turn with its response.
        light_azimuths=tuple(float(a) for a in azimuths),
        shadow=typical.shadow * channels,
        blur_sigmas=blur_sigmas,
    )
    h, w = sensor.image_shape
    smooth = cv2.resize(rng.normal(0, 1, (4, 5, 3)), (w, h), interpolation=cv2.INTER_CUBIC)
    offset = randomization.offset * rng.normal(size=3)
    counts = typical.background * brightness + (offset + randomization.pattern * smooth)
    tile = h + NOISE_MARGIN, w + NOISE_MARGIN
    shared, own = rng.standard_normal(tile), rng.standard_normal((*tile, 3))
    noise = typical.noise / COUNT_STEP * (_SHARED * shared[..., None] + _OWN * own)
    markers, radius = _markers(sensor, pitch, randomization.markers, rng)
    blurred = sensor.defocus * randomization.defocus
    return SensorInstance(
        calibration,
        _planes(counts / COUNT_STEP, np.int16),
        light,
        _planes(noise.clip(-127, 127), np.int8),
        markers,
        radius,
        rng.uniform(0, blurred) if blurred else 0.0,
    )


def _planes(pixels: Float[np.ndarray, "h w 3"], kind: type) -> np.ndarray:
    """Return numbers by pixel and channel as one plane of integers for each channel."""
    return np.moveaxis(pixels, -1, 0).astype(kind, order="C")


def _typical(sensor: SensorModel) -> tuple[SensorCalibration, Float32[np.ndarray, "3 h3 w3"]]:
    """Return a model's sensor file and the light in it, kept until the file changes."""
    folder = sensor.sensor_file
    changed = tuple(p.stat().st_mtime_ns for p in sorted(folder.glob("*")))
    return _read(folder, changed, sensor.image_shape)


@lru_cache(maxsize=4)
def _read(
    folder: Path, changed: tuple[int, ...], shape: tuple[int, int]
) -> tuple[SensorCalibration, Float32[np.ndarray, "3 h3 w3"]]:
    typical, half = load(folder), (shape[1] // 2, shape[0] // 2)
    light = illumination(typical.background, typical.illumination_exponent)
    light = cv2.resize(light, half, interpolation=cv2.INTER_AREA)
    return typical, np.ascontiguousarray(np.moveaxis(light, -1, 0), np.float32)


def _turned(
    response: Float32[np.ndarray, "3 k 3"], turns: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "3 k 3"]:
    """Turn the lights of a response about the sensor's axis, rad from x towards y (exactly)."""
    x, y, inverse = _normals()
    turned = response.copy()
    for channel, c, s in zip(turned, np.cos(turns), np.sin(turns), strict=True):
        rotated = monomials(x * c + y * s, y * c - x * s)
        channel[: len(inverse)] = inverse @ (rotated.T @ channel[: len(inverse)])
    return turned


@cache
def _normals() -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "9 n"]]:
    """Return x and y of some normals, and what fits `monomials` to values at them."""
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 64))
    return x, y, np.linalg.pinv(monomials(x, y).T)


def _markers(
    sensor: SensorModel, pitch: float, randomization: float, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "n 2"], float]:
    if sensor.markers is None:
        return np.empty((0, 2), np.float32), 1.0
    grid = sensor.markers
    shift = randomization * rng.uniform(-1, 1, 2) * grid.pitch / pitch
    size = 1 + randomization * rng.uniform(-1, 1)
    rest = rest_positions(grid, sensor.image_shape, pitch) + shift.astype(np.float32)
    return rest, size * grid.diameter / pitch / 2

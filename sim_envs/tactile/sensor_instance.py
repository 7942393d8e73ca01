"""Differences between two sensors of one model."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8, Int16, Shaped, UInt8

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
    background = typical.background * brightness
    background += randomization.offset * rng.normal(size=3) + randomization.pattern * smooth
    tile = (h + NOISE_MARGIN, w + NOISE_MARGIN, 3)
    common = np.sqrt(0.3)  # 0.3 of the noise variance is the same in all channels
    noise = common * rng.normal(size=(*tile[:2], 1)) + np.sqrt(0.7) * rng.normal(size=tile)
    markers, radius = _markers(sensor, pitch, randomization.markers, rng)
    return SensorInstance(
        calibration,
        _planar(background / COUNT_STEP, np.int16),
        light,
        _planar(np.clip(typical.noise / COUNT_STEP * noise, -127, 127), np.int8),
        markers,
        radius,
    )


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
    light = _planar(cv2.resize(light, half, interpolation=cv2.INTER_AREA), np.float32)
    return typical, light


def _planar(image: Shaped[np.ndarray, "h w 3"], kind: type) -> Shaped[np.ndarray, "3 h w"]:
    return np.ascontiguousarray(np.moveaxis(image, -1, 0), kind)


def _turned(
    response: Float32[np.ndarray, "3 k 3"], turns: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "3 k 3"]:
    """Turn the lights of a response about the sensor's axis, rad from x towards y (exactly)."""
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 64))
    basis = monomials(x, y).T
    n = basis.shape[1]
    turned = response.copy()
    for channel, c, s in zip(turned, np.cos(turns), np.sin(turns), strict=True):
        rotated = monomials(x * c + y * s, y * c - x * s).T @ channel[:n]
        channel[:n] = np.linalg.lstsq(basis, rotated, rcond=None)[0]
    return turned


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

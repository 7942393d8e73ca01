"""Within-surface covariance of touch features, estimated on simulated presses.

Variation between presses of one surface is a nuisance; the inverse square root of its covariance
gives distances that ignore it (Hatch et al. 2006).
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np
import torch
from jaxtyping import Float32

from touchgoal.control.arrays import Image
from touchgoal.control.tactile.sensor_models import SensorModel
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder, PooledEncoderConfig
from touchgoal.encoders.whitening.covariance import inverse_square_root
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.rig.surface_press import press, random_pose
from touchgoal.sim_envs.tactile.rig.surfaces import Surface, random_surface
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance

_UNITS = 48
_BATCH = 32
_SHRINKAGE = 0.1  # share of a sphere; 0.01 to 0.3 separate real objects equally well
_VISIBLE = 4.0  # counts: least change of a visible press
_TRIES = 3  # presses that are drawn until one is visible
# Brightness change between the two images, common and by channel; JPEG quality; share of compressed
# streams.
_COMMON_DRIFT, _CHANNEL_DRIFT = 0.03, 0.01
_QUALITY = 40, 95
_COMPRESSED = 0.7


Press = tuple[Image, Image]
"""The untouched and the pressed sensor, RGB."""


def train(sensor: SensorModel, surfaces: int, presses: int, seed: int) -> PooledEncoder:
    """Return an encoder for a sensor, fitted to simulated presses of random surfaces.

    600 surfaces do as well on real objects as 2000.
    """
    encoder = PooledEncoder(PooledEncoderConfig.for_sensor(sensor.name))
    d = encoder.config.features
    total, square, within = np.zeros(d), np.zeros((d, d)), np.zeros((d, d))
    step = max(1, _BATCH // presses)
    batches = _pooled(encoder, pressed_surfaces(sensor, surfaces, presses, seed), step)
    for rows in track(batches, "surfaces", "batch", -(-surfaces // step)):
        total += rows.sum((0, 1))
        flat = rows.reshape(-1, d)
        square += flat.T @ flat
        apart = (rows - rows.mean(1, keepdims=True)).reshape(-1, d)
        within += apart.T @ apart
    mean = total / (surfaces * presses)
    spread = np.sqrt(np.diag(square) / (surfaces * presses) - mean**2) + 1e-4
    covariance = within / (surfaces * (presses - 1)) / np.outer(spread, spread)
    whitening = inverse_square_root(covariance, _SHRINKAGE) / spread[:, None]
    return encoder.fit(mean, whitening)


def pressed_surfaces(
    sensor: SensorModel, surfaces: int, presses: int, seed: int
) -> Iterator[tuple[Surface, list[Press]]]:
    """Yield random surfaces with their presses, each on another sensor instance."""
    units = sensor_units(sensor, seed)
    for i in range(surfaces):
        rng = np.random.default_rng([seed, 1, i])
        surface = random_surface(rng)
        filmed = []
        for _ in range(presses):
            unit = units[rng.integers(_UNITS)]
            filmed.append(_filmed(*visible_press(surface, unit, rng), rng))
        yield surface, filmed


def _pooled(
    encoder: PooledEncoder, pressed: Iterator[tuple[Surface, list[Press]]], step: int
) -> Iterator[Float32[np.ndarray, "surfaces presses d"]]:
    """Yield the pooled features of `step` surfaces at a time."""
    while some := list(islice(pressed, step)):
        touches = [
            encoder.preprocess(after[None], before)[0]
            for _, presses in some
            for before, after in presses
        ]
        rows = encoder.pool(torch.from_numpy(np.stack(touches))).numpy()
        yield rows.reshape(len(some), -1, rows.shape[1])


def sensor_units(sensor: SensorModel, seed: int) -> list[SensorInstance]:
    """Return the sensor instances of a seed, their responses stronger or weaker than the file's."""
    rng = np.random.default_rng([seed, 0])
    return [_unit(sensor, rng) for _ in range(_UNITS)]


def _unit(sensor: SensorModel, rng: np.random.Generator) -> SensorInstance:
    instance = sample_instance(sensor, rng)
    strength = rng.uniform(0.75, 1.3) * rng.uniform(0.85, 1.15, (3, 1, 1))
    response = (instance.calibration.response * strength).astype(np.float32)
    return replace(instance, calibration=replace(instance.calibration, response=response))


def visible_press(surface: Surface, unit: SensorInstance, rng: np.random.Generator) -> Press:
    """Return a random press that can be seen, or the last of a few."""
    rest = unit.with_dots(render_untouched(unit, rng))
    frame = rest
    for _ in range(_TRIES):
        frame = press(surface, random_pose(rng), unit, rng)
        change = cv2.resize(frame.astype(np.float32) - rest, (40, 30), interpolation=cv2.INTER_AREA)
        if np.abs(change).max() > _VISIBLE:
            break
    return rest, frame


def _filmed(rest: Image, frame: Image, rng: np.random.Generator) -> Press:
    """Return the images as recorded: at another brightness, and mostly compressed."""
    quality = int(rng.integers(*_QUALITY)) if rng.random() < _COMPRESSED else None
    gain = 1 + _COMMON_DRIFT * rng.normal() + _CHANNEL_DRIFT * rng.normal(size=3)
    lit = np.rint(frame * gain).clip(0, 255).astype(np.uint8)
    return _sent(rest, quality), _sent(lit, quality)


def _sent(frame: Image, quality: int | None) -> Image:
    if quality is None:
        return frame
    data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded

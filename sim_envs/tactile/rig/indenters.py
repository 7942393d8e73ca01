"""Ten indenters of finite size, pressed into a sensor's gel with a known force: for probes of touch."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.tactile.gel import deform
from touchgoal.sim_envs.tactile.optics import render
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance

FOUNDATION_MODULUS = 3e8
"""Pa/m, of every gel here, so that one force looks alike on all sensors: a Mini's."""
FIELD = 11e-3
"""m, side of the square in the middle of the gel in which indenters press: all sensors show it."""
_NOTHING = np.float32(-1.0)  # m: no indenter there
_STEPS = 24  # of the search for the depth of a force
_DEEPEST = 2e-3  # m

Map = Float32[np.ndarray, "h w"]


def _disc(x: Map, y: Map, radius: float, height: Map) -> Map:
    return np.where(np.hypot(x, y) < radius, height, _NOTHING)


def _block(x: Map, y: Map, half_x: float, half_y: float, height: Map) -> Map:
    return np.where((np.abs(x) < half_x) & (np.abs(y) < half_y), height, _NOTHING)


def _ball(radius: float) -> Callable[[Map, Map], Map]:
    return lambda x, y: np.sqrt(np.maximum(radius**2 - x * x - y * y, 0)) - radius


# Height over the indenter's own axes (m), its highest point near 0.
INDENTERS: dict[str, Callable[[Map, Map], Map]] = {
    "small ball": _ball(2.5e-3),
    "large ball": _ball(7e-3),
    "rod": lambda x, y: _block(x, y, 2e-3, 4e-3, np.sqrt(np.maximum(4e-6 - x * x, 0)) - 2e-3),
    "cone": lambda x, y: _disc(x, y, 3e-3, -0.5 * np.hypot(x, y)),
    "disc": lambda x, y: _disc(x, y, 2.2e-3, 0 * x),
    "ring": lambda x, y: np.where(np.hypot(x, y) > 1.4e-3, _disc(x, y, 2.6e-3, 0 * x), _NOTHING),
    "square": lambda x, y: _block(x, y, 1.8e-3, 1.8e-3, 0 * x),
    "bar": lambda x, y: _block(x, y, 0.5e-3, 3.5e-3, 0 * x),
    "ribs": lambda x, y: _block(x, y, 2.5e-3, 2.5e-3, 2e-4 * (np.cos(x / 0.2e-3) - 1)),
    "studs": lambda x, y: _block(
        x, y, 2.5e-3, 2.5e-3, 2e-4 * (np.cos(x / 0.25e-3) * np.cos(y / 0.25e-3) - 1)
    ),
}


@dataclass(frozen=True)
class IndenterPose:
    """How an indenter is held: its middle, m along x and y from the image's middle, and its turn, rad."""

    x: float
    y: float
    turn: float


def indent(
    name: str, pose: IndenterPose, force: float, unit: SensorInstance, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """What a sensor shows of an indenter pressed with a force, RGB.

    Args:
        name: of the indenter.
        pose: how it is held.
        force: N, of the gel as an elastic foundation.
        unit: the sensor.
        rng: of the camera's noise.
    """
    _, rows, columns = unit.background.shape
    pitch = np.float32(2 * unit.pixel_pitch)  # surfaces are at half the image's resolution
    y, x = (np.mgrid[: rows // 2, : columns // 2].astype(np.float32) + 0.5) * pitch
    x = x - np.float32(columns // 4 * pitch + pose.x)
    y = y - np.float32(rows // 4 * pitch + pose.y)
    c, s = np.float32(np.cos(pose.turn)), np.float32(np.sin(pose.turn))
    height = INDENTERS[name](c * x + s * y, c * y - s * x).astype(np.float32)
    least, most = 0.0, _DEEPEST
    for _ in range(_STEPS):
        depth = (least + most) / 2
        pressed = float(np.maximum(height + np.float32(depth), 0).sum()) * pitch**2
        if FOUNDATION_MODULUS * pressed > force:
            most = depth
        else:
            least = depth
    overlap = np.maximum(height + np.float32(least), 0)
    return render(deform(overlap, float(pitch), unit.calibration.blur_sigmas), unit, rng)

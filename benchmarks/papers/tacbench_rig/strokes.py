"""An indenter rig: a probe pressed into one fingertip sensor and drawn over it, without a robot.

After the load test of Sparsh (Higuera et al. 2024, appendix C.4): a press of at most 5 N, a slide
of at most 2 mm. Unlike in that test, a slide is about as long as the distance that friction holds,
so that sticking and slipping are both common, and there is no dynamics. While the probe sticks, the
gel moves along and its shear force grows; at the friction cone the probe slides.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from benchmarks.papers.tacbench_rig.config import Indenter, RigConfig, rig_unit
from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.sim_envs.object_slides import FRICTION, REST, stick_slip_force
from touchgoal.sim_envs.scene.objects import HARD, Body, Material, ObjectKind, Shape, Texture
from touchgoal.sim_envs.tactile.forces import ForceField, resample_to_image
from touchgoal.sim_envs.tactile.geometry import Grid
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench

FRICTION_SPREAD = 0.15  # largest relative deviation of a stroke's friction from `FRICTION`
MAX_SLIDE = 2e-3  # m
_PLACES = 3e-3  # m from the middle of the image, along x and y
_PRESS_FRAMES = 8, 16
_SLIDE_FRAMES = 12, 25
_SLIDES = 0.5, 3.0  # slide as a multiple of the distance that friction holds
_WOBBLE = 0.05  # relative change of the load while sliding
_TIP, _CONE, _OPENING = 0.3e-3, 4e-3, math.radians(120)  # sharp probe: m, m, rad
_SQUARES = 24  # rows and columns of an image's tractions
_FINE = 4  # samples along each side of such a square


@dataclass(frozen=True, eq=False)
class Stroke:
    """One press and slide."""

    frames: UInt8[np.ndarray, "t h w 3"]  # RGB, the first `REST` untouched
    # force (N) and torque (Nm) of the probe on the pad, sensor frame; pressed is -z
    wrench: Float32[np.ndarray, "t 6"]
    slip: Bool[np.ndarray, " t"]  # whether the probe slides over the gel
    field: Float32[np.ndarray, "t 3 24 24"]  # kPa, `_tractions`; not in recordings
    indenter: Indenter
    load: float  # largest normal load, N
    friction: float  # coefficient of this stroke


def simulate(config: RigConfig, index: int) -> Stroke:
    """Simulate one stroke; the same config and index always give the same one."""
    sensor, rng = find_sensor(config.sensor), np.random.default_rng([config.seed, index, 1])
    indenter = config.indenters[index % len(config.indenters)]
    friction = FRICTION * (1 + FRICTION_SPREAD * rng.uniform(-1, 1))
    load, moved, start, direction = _draw_path(config, sensor, friction, rng)
    places = moved[:, None] * direction
    shear, slip = stick_slip_force(places, sensor.shear_stiffness, friction * load)
    unit = rig_unit(config)
    bench = PressBench(_probe(indenter, friction), sensor, unit, config.shear_relief)
    frames, wrenches, fields = [], [], []
    for pressed, way, pull in zip(load.tolist(), moved, shear, strict=True):
        (x, y), (fx, fy) = (start + way * direction).tolist(), pull.tolist()
        bench.place(np.array([x, y, 0.0]))
        sensed = bench.sense(pressed, rng, (fx, fy), (x, y), -pressed / sensor.normal_stiffness)
        frames.append(sensed.image)
        fields.append(_tractions(sensed.field, sensor.image_shape, unit.pixel_pitch))
        wrenches.append(np.concatenate([bench.contact.force, bench.contact.torque]))
    wrench = np.array(wrenches, np.float32)
    return Stroke(np.stack(frames), wrench, slip, np.stack(fields), indenter, load.max(), friction)


def _tractions(
    field: ForceField | None, shape: tuple[int, int], pitch: float
) -> Float32[np.ndarray, "3 24 24"]:
    """Return shear along x and y and pressure over an image, kPa, averaged over 24 x 24 cells.

    Args:
        field: the contact's forces; None without contact.
        shape: rows and columns of the image of `pitch` m per pixel.
    """
    if field is None:
        return np.zeros((3, _SQUARES, _SQUARES), np.float32)
    step = max(shape) * pitch / (_SQUARES * _FINE)
    fine = Grid(round(shape[0] * pitch / step), round(shape[1] * pitch / step), step)
    stress = np.stack([*field.tangential, field.normal]) / (1e3 * field.pitch**2)
    planes = (resample_to_image(plane, field, fine) for plane in stress)
    size = _SQUARES, _SQUARES
    return np.stack([cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in planes])


def _draw_path(
    config: RigConfig, sensor: SensorModel, friction: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw a stroke: load (N) and distance (m) by frame, first place (m), direction."""
    load = rng.uniform(*config.load)
    pressing, sliding = int(rng.integers(*_PRESS_FRAMES)), int(rng.integers(*_SLIDE_FRAMES))
    held = friction * load / sensor.shear_stiffness
    length = min(rng.uniform(*_SLIDES) * held, MAX_SLIDE)
    press = np.linspace(0, 1, pressing + 1)[1:]
    slide = np.linspace(0, 1, sliding + 1)[1:]
    phase, turns = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2)
    wobble = 1 + _WOBBLE * (np.sin(phase + 2 * np.pi * turns * slide) - np.sin(phase))
    way = rng.uniform(0, 2 * np.pi)
    loads = load * np.concatenate([np.zeros(REST), press, wobble])
    moved = length * np.concatenate([np.zeros(REST + pressing), slide])
    start = rng.uniform(-_PLACES, _PLACES, 2)
    return loads, moved, start, np.array([np.cos(way), np.sin(way)])


def _probe(indenter: Indenter, friction: float) -> Body:
    """Return a hard smooth probe, its tip towards the gel (the body's -z)."""
    material = Material(Texture.SMOOTH, 0.0, 1e-3, HARD, friction, (0.6, 0.6, 0.6, 1.0))
    shapes: dict[Indenter, tuple[Shape, tuple[float, ...]]] = {
        "sphere": ("sphere", (4e-3,)),
        "flat": ("cylinder", (3e-3, 4e-3)),
        "sharp": ("mesh", (1.0,)),
    }
    shape, size = shapes[indenter]
    hull = _blunt_cone() if shape == "mesh" else None
    return Body(ObjectKind(indenter, shape, material, ()), size, 0.1, "probe", hull)


def _blunt_cone() -> Float[np.ndarray, "n 3"]:
    """Return points of a cone about z, its blunt tip at z = 0 and its base above."""
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rings = ((_TIP, 0.0), (_CONE, (_CONE - _TIP) / math.tan(_OPENING / 2)))
    return np.concatenate(
        [np.column_stack([r * np.cos(angle), r * np.sin(angle), 0 * angle + z]) for r, z in rings]
    )

"""Objects held against one fingertip sensor and slid and turned under it by hand.

As in Sparsh's appendix C.5 the load is constant and the velocity changes every fraction of a
second. Changes of the pose over five frames are drawn log-uniformly. A turn counts as the way along
a ring of the patch's mean radius.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from touchgoal.control.tactile.sensor_models import SensorModel, find_sensor
from touchgoal.sim_envs.scene.objects import CATALOGUE, Body, sample_body
from touchgoal.sim_envs.tactile.forces import ForceField
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance

FPS = 60  # images a second, a DIGIT's
FRICTION = 0.6  # friction coefficient of an object on the gel
LOAD = 0.5, 5.0  # N: range of the normal load
REST = 6
"""Untouched frames at the start: the first pair of frames, 5 apart, is untouched."""
FRAMES = 60  # frames of a slide, after the untouched ones
_SEGMENT = 6, 13  # frames of one velocity, half-open range
_WINDOW = 5  # frames over which changes are drawn
_SHIFTS, _TURNS = (0.03e-3, 8e-3), (math.radians(0.02), math.radians(4))  # least and most change
_MASS = 0.1  # kg: slides have no dynamics
_FIELD, _TURN = 3.5e-3, math.radians(30)  # m and rad from the middle, at most


@dataclass(frozen=True, eq=False)
class Slide:
    """One object moved over the sensor."""

    frames: UInt8[np.ndarray, "t h w 3"]  # RGB, the first `REST` untouched
    wrench: Float32[np.ndarray, "t 6"]  # N and Nm of the object on the pad, sensor frame
    slip: Bool[np.ndarray, " t"]  # whether it slides over the gel
    pose: Float32[np.ndarray, "t 3"]  # of the object: x, y (m), turn about z (rad); sensor frame
    held: str  # name of the object
    load: float  # normal load, N


def simulate_object_slide(sensor: str, seed: int, index: int) -> Slide:
    """Simulate one slide of an object of pick-and-place, any side of it, on a sensor of its own."""
    model, rng = find_sensor(sensor), np.random.default_rng([seed, index, 5])
    kinds = list(CATALOGUE.values())
    body = sample_body(kinds[index % len(kinds)], rng, _MASS)
    load = float(rng.uniform(*LOAD))
    unit = sample_instance(model, rng)
    return slide(body, _random_side(rng), load, model, unit, True, rng)


def slide(
    body: Body,
    side: Float[np.ndarray, "3 3"],
    load: float,
    sensor: SensorModel,
    unit: SensorInstance,
    relief: bool,
    rng: np.random.Generator,
) -> Slide:
    """Slide a body over a sensor.

    Args:
        side: the body's rotation at turn 0.
        load: normal force, N.
        relief: whether the gel piles up in front of what slides over it.
    """
    pose = _draw_poses(rng)
    bench = PressBench(body, sensor, unit, relief)
    depth = -load / sensor.normal_stiffness

    def place(at: Float[np.ndarray, "3"]) -> tuple[float, float]:
        bench.place(np.array([at[0], at[1], 0.0]), _turned(at[2]) @ side)
        return float(at[0]), float(at[1])

    centre = place(pose[0])
    touched = bench.sense(load, np.random.default_rng(0), centre=centre, depth=depth).field
    radius = mean_radius(touched) if touched is not None else 0.0
    pull, slip = stick_slip_force(pose * [1, 1, radius], sensor.shear_stiffness, FRICTION * load)
    pull[:, 2] *= radius
    frames, wrenches = [], []
    for _ in range(REST):
        frames.append(bench.sense(0.0, rng, centre=centre).image)
        wrenches.append(np.zeros(6))
    for at, (fx, fy, torsion) in zip(pose, pull, strict=True):
        acting = (float(fx), float(fy)), place(at), depth, float(torsion)
        frames.append(bench.sense(load, rng, *acting).image)
        wrenches.append(np.concatenate([bench.contact.force, bench.contact.torque]))
    wrench = np.array(wrenches, np.float32)
    whole = np.vstack([np.repeat(pose[:1], REST, 0), pose]).astype(np.float32)
    slides = np.concatenate([np.zeros(REST, bool), slip])
    return Slide(np.stack(frames), wrench, slides, whole, body.kind.name, load)


def stick_slip_force(
    places: Float[np.ndarray, "t d"], stiffness: float, limits: Float[np.ndarray, " t"] | float
) -> tuple[Float[np.ndarray, "t d"], Bool[np.ndarray, " t"]]:
    """Return forces (N) on a gel of `stiffness` N/m under an object at these places (m), and slip.

    The gel's rest position is dragged along where the force would exceed the limit (N) of the frame.
    `places`: x, y and, for turns, angle times the patch's mean radius; the third force is torsion
    over that radius.
    """
    rest = places[0].astype(float)
    force, slip = np.zeros(places.shape), np.zeros(len(places), bool)
    for i, limit in enumerate(np.broadcast_to(limits, len(places))):
        force[i] = stiffness * (places[i] - rest)
        size = float(np.linalg.norm(force[i]))
        if size > limit:
            force[i] *= limit / size
            rest, slip[i] = places[i] - force[i] / stiffness, True
    return force, slip


def mean_radius(field: ForceField) -> float:
    """Return the mean distance of the load from its centre, m."""
    y, x = np.indices(field.normal.shape)
    normal, load = field.normal, field.normal.sum()
    away = np.hypot(x - (normal * x).sum() / load, y - (normal * y).sum() / load)
    return float((normal * away).sum() / load * field.pitch)


def _draw_poses(rng: np.random.Generator) -> Float[np.ndarray, "t 3"]:
    """Draw x, y (m) and turn (rad) by frame; velocities reverse at the field's edge."""
    most = np.array([_FIELD, _FIELD, _TURN])
    ranges = np.log([_SHIFTS, _SHIFTS, _TURNS])
    pose = np.empty((FRAMES, 3))
    pose[0] = rng.uniform(-0.5, 0.5, 3) * most
    left, velocity = 0, np.zeros(3)
    for i in range(1, FRAMES):
        if left == 0:
            left = int(rng.integers(*_SEGMENT))
            size = np.exp(rng.uniform(ranges[:, 0], ranges[:, 1])) / _WINDOW
            velocity = size * rng.choice([-1, 1], 3)
        velocity = np.where(np.abs(pose[i - 1] + velocity) > most, -velocity, velocity)
        pose[i] = pose[i - 1] + velocity
        left -= 1
    return pose


def _random_side(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Draw a rotation; half of them align an object's axis with the sensor's."""
    if rng.random() < 0.5:
        rotation = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)
    else:
        rotation, triangle = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.diag(triangle))  # makes the rotation uniformly random
    rotation[:, 0] *= np.linalg.det(rotation)  # a rotation, not a mirror
    return rotation


def _turned(angle: float) -> Float[np.ndarray, "3 3"]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])

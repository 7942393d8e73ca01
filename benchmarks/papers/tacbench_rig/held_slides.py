"""Slides of a bar and a can, for TacBench T3 (pose)."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from benchmarks.papers.tacbench_rig.config import RigConfig, rig_unit
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.sim_envs.object_slides import FRICTION, Slide, slide
from touchgoal.sim_envs.scene.objects import HARD, Body, Material, ObjectKind, Texture

HeldObject = Literal["bar", "can"]
HELD: tuple[HeldObject, ...] = ("bar", "can")
_MASS = 0.1  # kg: slides have no dynamics


def simulate_slide(config: RigConfig, index: int) -> Slide:
    """Simulate a slide of the bar or the can; config and index determine it."""
    rng = np.random.default_rng([config.seed, index, 2])
    load = float(rng.uniform(*config.load))
    body, flat = _body(HELD[index % len(HELD)])
    sensor = find_sensor(config.sensor)
    return slide(body, flat, load, sensor, rig_unit(config), config.shear_relief, rng)


def _body(held: HeldObject) -> tuple[Body, Float[np.ndarray, "3 3"]]:
    """Return the object, and its rotation on the gel at turn 0."""
    material = Material(Texture.SMOOTH, 0.0, 1e-3, HARD, FRICTION, (0.6, 0.6, 0.6, 1.0))
    if held == "bar":
        return Body(ObjectKind(held, "box", material, ()), (4e-3, 1.5e-3, 4e-3), _MASS), np.eye(3)
    lying = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # its axis along the sensor's x
    return Body(ObjectKind(held, "cylinder", material, ()), (8e-3, 3.5e-3), _MASS), lying

"""Options of TacBench's simulated bench."""

from typing import Annotated, Literal

import numpy as np

from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.runtime.option_types import ORDERED, RARE, Positive, Seed, checked_dataclass
from touchgoal.sim_envs.object_slides import LOAD
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance

Indenter = Literal["sphere", "sharp", "flat"]
"""A probe of the indenter rig."""


@checked_dataclass
class RigConfig:
    """Options of the indenter rig."""

    sensor: str = "gelsight_mini_markers"
    """Fingertip sensor: a name or the folder of a sensor file."""
    indenters: tuple[Indenter, ...] = ("sphere", "sharp", "flat")
    """Probes, used in turn."""
    load: Annotated[tuple[Positive, Positive], ORDERED, RARE] = LOAD
    """Range of the normal load, N."""
    shear_relief: bool = True
    """Simulate that the gel piles up in front of what slides over it and sinks behind: the only
    trace of shear without printed dots. Shipped encoders were trained without it."""
    seed: Seed = 0
    """Random seed of the sensor and of all strokes."""


def rig_unit(config: RigConfig) -> SensorInstance:
    """Draw the rig's sensor, the same one for all strokes of a config."""
    return sample_instance(find_sensor(config.sensor), np.random.default_rng([config.seed, 0]))

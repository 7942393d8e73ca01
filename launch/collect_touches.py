"""Record objects slid over a simulated sensor, to learn from without labels."""

import os
from pathlib import Path
from typing import Any

from touchgoal.runtime.option_types import Count, Seed, checked_dataclass


@checked_dataclass
class Config:
    """Options of collect-touches."""

    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`. A folder that holds some already gets
    those that are missing."""
    episodes: Count = 300
    """Number of episodes: one object each, slid and turned for a second, 66 pictures at 60 Hz, on a unit
    of its own of the sensor. Sparsh learned from 460,000 pictures: 7000."""
    sensor: str = "gelsight_mini_markers"
    """Fingertip sensor, by name or folder of a sensor file."""
    seed: Seed = 0
    """Random seed of all episodes."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""


def main(config: Any) -> None:
    """Record what is missing."""
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.episodes.bench_recording import record_catalogue_slides
    from touchgoal.runtime.interruption import on_interruption
    from touchgoal.runtime.run_folder import open_run
    from touchgoal.sim_envs.config import RigConfig

    find_sensor(config.sensor)  # a wrong one is refused before anything is written
    out = open_run(config.out, "collect-touches", config, adds=True)
    root = out / "episodes"
    rig = RigConfig(sensor=config.sensor, seed=config.seed)
    with on_interruption(
        lambda: f"what was recorded is kept in {root}; the same line with --out {out} goes on"
    ):
        episodes = record_catalogue_slides(root, rig, config.episodes, config.workers)
    pictures = sum(episodes.lengths)
    print(f"{len(episodes)} episodes, {pictures} pictures in {root}")

"""Record objects slid over a simulated sensor, to train on without labels."""

import os
from pathlib import Path
from typing import Any

from touchgoal.runtime.option_types import Count, Seed, checked_dataclass


@checked_dataclass
class Config:
    """Options of collect-touches."""

    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`. Only missing ones are recorded, so the same
    line continues an interrupted recording."""
    episodes: Count = 300
    """Number of episodes: one object each, slid and turned for a second, 66 images at 60 Hz, on another
    sensor instance. Sparsh trained on 460,000 images, which 7000 episodes give."""
    sensor: str = "gelsight_mini_markers"
    """Fingertip sensor, by name or folder of a sensor file."""
    seed: Seed = 0
    """Random seed."""
    workers: Count = os.cpu_count() or 1
    """Number of simulating processes."""


def main(config: Any) -> None:
    """Record the missing episodes."""
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.episodes.bench_recording import record_bench
    from touchgoal.episodes.format.set_files import INFO
    from touchgoal.episodes.store import EpisodeSet
    from touchgoal.runtime.interruption import on_interruption
    from touchgoal.runtime.run_folder import open_run
    from touchgoal.sim_envs.config import RigConfig

    find_sensor(config.sensor)  # a wrong one is refused before anything is written
    out = open_run(config.out, "collect-touches", config, adds=True)
    root = out / "episodes"
    recorded = (root / INFO).exists() and len(EpisodeSet(root)) >= config.episodes
    rig = RigConfig(sensor=config.sensor, seed=config.seed)
    kept = f"finished episodes are in {root}; the same line with --out {out} continues"
    with on_interruption(lambda: kept):
        episodes = record_bench("catalogue slides", root, rig, config.episodes, config.workers)
    if recorded:
        print("nothing left to record:", end=" ")
    print(f"{len(episodes)} episodes, {sum(episodes.lengths)} images in {root}")

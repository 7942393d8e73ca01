"""Record touches: the objects of MMWand under a simulated wand, or objects slid over a sensor."""

import os
from pathlib import Path
from typing import Any, Literal

from touchgoal.runtime.option_types import Count, Seed, checked_dataclass

_DEFAULT = {"wand": (5182, "gelsight_mini"), "slide": (300, "gelsight_mini_markers")}


@checked_dataclass
class Config:
    """Options of collect-touches."""

    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`. Only missing ones are recorded, so the same
    line continues an interrupted recording."""
    body: Literal["wand", "slide"] = "wand"
    """wand: each of 102 objects touched anywhere with 0 to 20 N, with four views, force and sentences (the
    MMWand data set). slide: one object slid and turned over the sensor for a second, 66 pictures at 60 Hz,
    to learn from without labels; Sparsh's 460,000 pictures are 7,000 of these."""
    episodes: Count | None = None
    """Number of touches or slides; by default 5182 touches, as MMWand has, or 300 slides."""
    sensor: str | None = None
    """Fingertip sensor, by name or folder of a sensor file; by default gelsight_mini for the wand,
    gelsight_mini_markers for slides."""
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
    from touchgoal.episodes.wand_recording import record_touches
    from touchgoal.runtime.interruption import on_interruption
    from touchgoal.runtime.run_folder import open_run
    from touchgoal.sim_envs.config import RigConfig

    count = config.episodes or _DEFAULT[config.body][0]
    sensor = config.sensor or _DEFAULT[config.body][1]
    find_sensor(sensor)  # a wrong one is refused before anything is written
    out = open_run(config.out, "collect-touches", config, adds=True)
    root = out / "episodes"
    recorded = (root / INFO).exists() and len(EpisodeSet(root)) >= count
    with on_interruption(
        lambda: f"finished episodes are in {root}; the same line with --out {out} continues"
    ):
        if config.body == "wand":
            episodes = record_touches(root, sensor, config.seed, count, config.workers)
        else:
            rig = RigConfig(sensor=sensor, seed=config.seed)
            episodes = record_bench("catalogue slides", root, rig, count, config.workers)
    if recorded:
        print("nothing left to record:", end=" ")
    print(f"{len(episodes)} episodes, {sum(episodes.lengths)} images in {root}")
    if config.body == "wand":
        print(_table_row(episodes))


def _table_row(episodes: Any) -> str:
    """Return the set's row of MMWand's Table I."""
    objects = {str(episodes.meta(i)["object"]) for i in range(len(episodes))}
    return (
        "\nData set (MMWand, Table I)     objects   touches   source      labels   views   language   other\n"
        "MMWand as published                102     5,182   human       yes      4       yes        vision, touch, force\n"
        f"this set                    {len(objects):>10}{len(episodes):>10,}   simulation  yes      4       yes        "
        "vision, touch, force"
    )

"""Record touches: of a simulated wand (the MMWand data set), of a real one, or slides over a sensor.

With --wand FILE a person presses a real wand on real objects. FILE names its devices: copy
control/cell/examples/wand.toml. Hold the wand free and still until it says "press"; press slowly by hand,
hold until it says "lift", and lift. It asks for the force range with the fewest touches. Every touch is on
disk before the next begins; Ctrl-C ends, and the same command with --out continues. Run it once per
object:

    touchgoal collect-touches --wand wand.toml --object apple --out runs/wand
    touchgoal collect-touches --wand wand.toml --object mug --description "smooth, hard and cold" --out runs/wand
"""

import os
from pathlib import Path
from typing import Any, Literal

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.runtime.run_folder import open_run

_DEFAULT = {"wand": (5182, "gelsight_mini"), "slide": (300, "gelsight_mini_markers")}


@checked_dataclass
class Config:
    """Options of collect-touches."""

    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`. Only missing ones are recorded, so the same
    command continues an interrupted recording."""
    body: Literal["wand", "slide"] = "wand"
    """wand: each of 102 objects touched anywhere with 0 to 20 N, with four views, force and sentences (the
    MMWand data set). slide: one object slid and turned over the sensor for a second, 66 images at 60 Hz,
    to learn from without labels; Sparsh's 460,000 images are 7,000 of these."""
    episodes: Count | None = None
    """Number of touches or slides; by default 5182 touches, as MMWand has, or 300 slides. With a real wand:
    number of touches of this object; by default without end."""
    sensor: str | None = None
    """Fingertip sensor, by name or folder of a sensor file; by default gelsight_mini for the wand,
    gelsight_mini_markers for slides."""
    seed: Seed = 0
    """Random seed."""
    shard: str = "0/1"
    """Record part I of N, as I/N counted from 0, each part with its own --out; see collect-demos."""
    workers: Count = os.cpu_count() or 1
    """Number of simulating processes."""
    ray: str | None = None
    """Address of a Ray cluster whose cores work in place of --workers; auto: one started on this machine."""
    wand: Path | None = None
    """File that names the devices of a real wand, which then records in place of the simulated one."""
    object: str | None = None
    """Object that the real wand touches: one of MMWand's 102 (a wrong name lists them), or one of your own
    with --description."""
    description: tuple[str, ...] = ()
    """How an object of your own feels; three to five sentences in different words are best."""
    new_gel: bool = False
    """The gel of the real wand was exchanged after the last touch in --out."""


def main(config: Any) -> None:
    """Record the missing episodes."""
    if config.wand is None:
        _simulate(config)
    else:
        _record_real(config)


def _simulate(config: Any) -> None:
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.episodes.format.set_files import INFO
    from touchgoal.episodes.slide_recording import record_slides
    from touchgoal.episodes.store import EpisodeSet
    from touchgoal.episodes.wand.recording import record_touches, visits
    from touchgoal.runtime.interruption import on_interruption
    from touchgoal.runtime.parallel.shard import parse_shard

    workers = config.ray or config.workers
    count = config.episodes or _DEFAULT[config.body][0]
    shard = parse_shard(config.shard, visits(count) if config.body == "wand" else count)
    if config.object or config.description or config.new_gel:
        raise UserError(
            "--object, --description and --new-gel are for a real wand: give --wand FILE"
        )
    sensor = config.sensor or _DEFAULT[config.body][1]
    find_sensor(sensor)  # a wrong one is refused before anything is written
    out = open_run(config.out, "collect-touches", config, adds=True)
    root = out / "episodes"
    before = len(EpisodeSet(root)) if (root / INFO).exists() else 0
    with on_interruption(
        lambda: f"finished episodes are in {root}; the same command with --out {out} continues"
    ):
        if config.body == "wand":
            episodes = record_touches(root, sensor, config.seed, count, workers, shard)
        else:
            episodes = record_slides(root, sensor, config.seed, count, workers, shard)
    if len(episodes) == before:
        print("nothing left to record:", end=" ")
    print(f"{len(episodes)} episodes, {sum(episodes.lengths)} images in {root}")


def _record_real(config: Any) -> None:
    """Record from a real wand until Ctrl-C, or the number of touches is reached."""
    from touchgoal.control.cell.config_file import read_config
    from touchgoal.control.cell.wand import WandConfig
    from touchgoal.episodes.wand.real_recording import record_real_touches

    if config.body != "wand" or config.sensor or config.shard != "0/1":
        raise UserError(
            "--wand FILE records touches, and the file names the sensor: leave out --body, --sensor "
            "and --shard"
        )
    name, descriptions = _described(config.object, config.description)
    wand = read_config(config.wand, WandConfig, "wand file")
    out = open_run(config.out, "collect-touches", config, adds=True)
    root = out / "episodes"
    episodes = record_real_touches(root, wand, name, descriptions, config.episodes, config.new_gel)
    if episodes is None:
        raise UserError("no touch was recorded")
    print(f"{len(episodes)} touches in {root}; the same command with --out {out} continues")


def _described(name: str | None, descriptions: tuple[str, ...]) -> tuple[str, tuple[str, ...]]:
    """Return an object's name and sentences: the user's own, or the catalogue's."""
    from touchgoal.sim_envs.wand.objects import find_wand_object

    if not name:
        raise UserError("--object is missing: name what the wand touches")
    if descriptions:
        return name, descriptions
    try:
        return name, find_wand_object(name).descriptions
    except UserError as error:
        raise UserError(f"--object: {error}; or say with --description how it feels") from error

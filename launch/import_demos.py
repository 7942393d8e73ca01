"""Make a set of episodes of recordings in other formats: HDF5, ROS bags, or videos with a table.

HDF5 is read as robomimic writes it (many episodes a file) or as ALOHA does (one a file); of ROS, rosbag2
folders, MCAP files and bags of ROS 1; else folders with an episode's videos and one CSV table. The first
call proposes a map, which stream becomes what, in which order, unit and rate, and writes it to a file. Look
at it, mend it, and call again with --map. Recordings that do not fit are left out and named.
"""

from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, checked_dataclass


@checked_dataclass
class Config:
    """Options of import-demos."""

    source: Annotated[Path, tyro.conf.Positional]
    """File of recordings, or folder of them."""
    map: Path | None = None
    """Map of streams to features, as this command writes it; default: one is proposed."""
    fps: Count | None = None
    """Frames per second of recordings that do not tell it, and of the set that is proposed. Default: the
    recording's, at most 20."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`."""


def main(config: Config) -> None:
    """Propose a map, or convert one recording after the other by a given one."""
    from touchgoal.control.cell.config_file import read_config
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.episodes.importers.feature_map import FeatureMap, propose_map
    from touchgoal.episodes.importers.find_recordings import find_recordings
    from touchgoal.episodes.store import EpisodeWriter
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.run_folder import open_run

    found = find_recordings(config.source, config.fps)
    if config.map is None:
        first, path = found[0](), Path(f"{config.source.stem}_map.json")
        if path.exists():
            raise UserError(f"{path} exists: give it by --map, or remove it")
        write_json(path, chosen := propose_map(first, config.fps))
        again = f"touchgoal import-demos {config.source} --map {path}"
        print(f"{chosen.table(first)}\nwritten to {path}; if it is right: {again}")
        return
    chosen = read_config(config.map, FeatureMap, "map")
    if not chosen.task:
        raise UserError(f"{config.map}: say in task, in words, what is done")
    if chosen.feels:
        find_sensor(chosen.sensor or "")
    out = open_run(config.out, "import-demos", config)
    writer, left = EpisodeWriter(out / "episodes", chosen.fps), []
    for read in track(found, "importing", "episode"):
        try:
            writer.append(chosen.episode(read()))
        except UserError as error:
            left.append(f"left out: {error}")
    writer.close()
    print("\n".join([*left, f"{len(writer)} episodes: {out / 'episodes'}"]))
    if not len(writer):
        raise UserError(f"no recording fits {config.map}: mend it")
    print(f"next: touchgoal train-policy --data {out / 'episodes'}")

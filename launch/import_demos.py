"""Make a set of episodes of recordings in other formats: HDF5, ROS bags, or videos with a table.

HDF5 is read as robomimic writes it (many episodes a file) or as ALOHA does (one a file); of ROS, rosbag2
folders, MCAP files and bags of ROS 1; else folders with an episode's videos and one CSV table. The command
proposes which stream becomes what, in which order, unit and rate; look at it, and confirm, or edit the
map that it wrote and give it by --map. Recordings that do not fit are left out and named.
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
    task: str
    """Task in words, such as "put the cup on the plate"."""
    map: Path | None = None
    """Map of streams to features, as this command writes it; default: one is proposed."""
    sensor: str = ""
    """Name of the fingertip sensor; see touchgoal list sensors."""
    fps: Count | None = None
    """Frames per second of the set. Default: the recording's, at most 20."""
    success: bool = False
    """All recordings are successes; default: as they tell themselves, if they do."""
    yes: bool = False
    """Do not ask whether the map is right."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`."""


def main(config: Config) -> None:
    """Propose, ask, convert one recording after the other."""
    from touchgoal.control.cell.config_file import read_config
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.episodes.importers.feature_map import FeatureMap, propose_map
    from touchgoal.episodes.importers.find_recordings import find_recordings
    from touchgoal.episodes.schema import Episode, MetaValue
    from touchgoal.episodes.store import EpisodeWriter
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.run_folder import open_run

    if config.sensor:
        find_sensor(config.sensor)
    found = find_recordings(config.source, config.fps)
    chosen = read_config(config.map, FeatureMap, "map") if config.map else None
    first = found[0]()
    chosen = chosen or propose_map(first, config.fps)
    out = open_run(config.out, "import-demos", config)
    write_json(out / "map.json", chosen)
    print(chosen.table(first))
    if not (config.map or config.yes):
        if input("is this right? y and Enter: import; Enter alone: end > ").strip().lower() != "y":
            print(f"edit {out / 'map.json'} and give it by --map")
            return
    writer, left = EpisodeWriter(out / "episodes", chosen.fps), []
    for read in track(found, "importing", "episode"):
        try:
            recording = read()
            success = True if config.success else recording.success
            meta: dict[str, MetaValue] = {"task": config.task, "sensor": config.sensor}
            meta |= {"source": recording.name} | ({} if success is None else {"success": success})
            writer.append(Episode(chosen.frames(recording), config.task, meta))
        except UserError as error:
            left.append(str(error))
    writer.close()
    print(
        "\n".join(
            [
                *(f"left out: {reason}" for reason in left),
                f"{len(writer)} episodes: {out / 'episodes'}",
            ]
        )
    )
    if not len(writer):
        raise UserError("no recording fits the map: edit map.json and give it by --map")
    print(
        f"next: touchgoal train-policy --data {out / 'episodes'}"
        + " --include-unknown" * (success is None)
    )

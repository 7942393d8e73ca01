"""Recordings in a file or in a folder of any depth, of every format that is read."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from touchgoal.control.sensors.clip import in_natural_order
from touchgoal.episodes.importers import hdf5, rosbag, video_table
from touchgoal.episodes.importers.streams import RawEpisode
from touchgoal.runtime.errors import UserError

_HDF5 = (".hdf5", ".h5")


def find_recordings(source: Path, fps: float | None) -> list[Callable[[], RawEpisode]]:
    """Return what reads each recording, in natural order; `fps` for those that do not tell their rate.

    UserError: there is none.
    """
    if not source.exists():
        raise UserError(f"{source} does not exist")
    found = _recordings(source, fps)
    if not found:
        raise UserError(
            f"{source} holds no recording that is read: HDF5 (robomimic, ALOHA), a rosbag2, MCAP or ROS 1 "
            "bag, or folders with an episode's videos and one CSV table"
        )
    return found


def _recordings(path: Path, fps: float | None) -> list[Callable[[], RawEpisode]]:
    if path.suffix.lower() in _HDF5:
        return hdf5.find_episodes(path, fps)
    if path.suffix.lower() in rosbag.SUFFIXES or (path / "metadata.yaml").is_file():
        return [partial(rosbag.read_bag, path)]
    if not path.is_dir():
        return []
    if video_table.is_video_table(path):
        return [partial(video_table.read_video_table, path)]
    return [one for inside in in_natural_order(path.iterdir()) for one in _recordings(inside, fps)]

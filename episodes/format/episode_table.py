"""Where each episode of a set lies: its rows in a data file, its frames in videos."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.set_files import Row


@dataclass(frozen=True)
class VideoPlace:
    """An episode's part of a video."""

    file: str  # path in the set
    first_frame: int
    n_frames: int
    crc32: int | None  # checksum of the file, if it holds this episode alone


@dataclass(frozen=True)
class EpisodePlace:
    """An episode's row of meta/episodes, and where its frames are."""

    facts: Row  # columns of meta/episodes but the statistics
    length: int  # number of frames
    data_file: str  # path in the set
    first_row: int  # in the data file
    alone: bool  # whether the data file holds no other episode
    videos: dict[str, VideoPlace]  # by key as stored

    @property
    def files(self) -> list[str]:
        """Paths in the set."""
        return [self.data_file, *(video.file for video in self.videos.values())]


def load_table(root: Path, leave_out: str | None = None) -> pa.Table:
    """Return meta/episodes, of all its files, without the columns that begin with `leave_out`.

    UserError: a file is missing or broken, or their columns are not of one type.
    """
    names = set_files.episodes_files(root)
    tables = [set_files.read_parquet(root, name, leave_out) for name in names]
    try:
        return pa.concat_tables(tables, promote_options="permissive").combine_chunks()
    except pa.ArrowException as error:
        raise set_files.unreadable(root, names[-1], error) from error


def locate_episodes(root: Path, info: dict[str, Any], table: pa.Table) -> list[EpisodePlace]:
    """Return the places of the episodes that info.json counts, in order.

    Rows of a data file are counted from its first listed one, and frames of a video by time stamps,
    as lerobot's reader does.

    UserError: meta/episodes lacks a column or an episode, or its lengths do not add up.
    """
    n = info["total_episodes"]
    try:
        rows = sorted(table.to_pylist(), key=lambda row: row["episode_index"])[:n]
        if len(rows) < n:
            raise ValueError(f"it lists {len(rows)} of {n} episodes")
        for i, row in enumerate(rows):
            if row["episode_index"] != i:
                raise ValueError(f"it has no episode {i}")
        return _places(rows, info)
    except KeyError as error:
        name = set_files.EPISODES
        raise set_files.unreadable(root, name, ValueError(f"no column {error}")) from error
    except (TypeError, ValueError) as error:
        raise set_files.unreadable(root, set_files.EPISODES, error) from error


def _places(rows: list[Row], info: dict[str, Any]) -> list[EpisodePlace]:
    keys = [key for key, feature in info["features"].items() if feature["dtype"] == "video"]
    in_data = Counter(set_files.data_path_of(row) for row in rows)
    in_videos = Counter(set_files.video_path_of(row, key) for row in rows for key in keys)
    first_of: dict[str, int] = {}
    places = []
    for i, row in enumerate(rows):
        first, length = row["dataset_from_index"], row["length"]
        file = set_files.data_path_of(row)
        if length < 1 or row["dataset_to_index"] - first != length:
            raise ValueError(f"episode {i} has a wrong length")
        videos = {}
        for key in keys:
            start, end = (row[f"videos/{key}/{end}_timestamp"] for end in ("from", "to"))
            path = set_files.video_path_of(row, key)
            crc32 = row.get(f"videos/{key}/crc32") if in_videos[path] == 1 else None
            frames = round(start * info["fps"]), round((end - start) * info["fps"])
            videos[key] = VideoPlace(path, *frames, crc32)
        row_in_file = first - first_of.setdefault(file, first)
        places.append(EpisodePlace(row, length, file, row_in_file, in_data[file] == 1, videos))
    return places

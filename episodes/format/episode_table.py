"""Where each episode of a set lies: its rows in a data file, its frames in videos.

A set may have millions of episodes, so facts and places stay in columns; the objects for one episode are made
when it is asked for.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int64

from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.set_files import Row

_ROWS = 100  # as Python objects at a time
_Numbers = Int64[np.ndarray, " n"]


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


def load_table(root: Path) -> pa.Table:
    """Return meta/episodes, of all its files, without the statistics.

    Its schema has metadata, such as touchgoal's mark, only if those of every file are the same.

    UserError: a file is missing or broken, or their columns are not of one type.
    """
    names = set_files.episodes_files(root)
    tables = [set_files.read_parquet(root, name, leave_out="stats/") for name in names]
    try:
        joined = pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise set_files.unreadable(root, names[-1], error) from error
    one = all(table.schema.metadata == joined.schema.metadata for table in tables)
    return joined if one else joined.replace_schema_metadata()


def rows_of(tables: Iterable[pa.Table]) -> Iterator[Row]:
    """Yield the rows of the files of meta/episodes, in order."""
    for table in tables:
        for batch in table.to_batches(max_chunksize=_ROWS):
            yield from batch.to_pylist()


class EpisodePlaces:
    """Places of the n episodes of a set, in order."""

    def __init__(self, root: Path, info: dict[str, Any], table: pa.Table) -> None:
        """Locate the episodes that info.json counts.

        Rows of a data file are counted from its first listed one, and frames of a video by time
        stamps, as lerobot's reader does.

        UserError: meta/episodes lacks a column or an episode, or its lengths do not add up.
        """
        try:
            rows = _in_order(table, info["total_episodes"])
            self._facts = {name: rows[name].combine_chunks() for name in rows.column_names}
            self.lengths: list[int] = _numbers(rows, "length").tolist()
            self._first_rows, self._data = _locate_data(rows)
            cameras = [key for key, f in info["features"].items() if f["dtype"] == "video"]
            self._videos = {key: _locate_videos(rows, key, info["fps"]) for key in cameras}
        except KeyError as error:
            name = set_files.EPISODES
            raise set_files.unreadable(root, name, ValueError(f"no column {error}")) from error
        except (TypeError, ValueError, pa.ArrowException) as error:
            raise set_files.unreadable(root, set_files.EPISODES, error) from error

    def __getitem__(self, i: int) -> EpisodePlace:
        facts = self.facts(i)
        videos = {
            key: VideoPlace(
                set_files.video_path_of(facts, key),
                int(first[i]),
                int(count[i]),
                facts.get(f"videos/{key}/crc32") if files.alone[i] else None,
            )
            for key, (first, count, files) in self._videos.items()
        }
        return EpisodePlace(
            facts,
            self.lengths[i],
            set_files.data_path_of(facts),
            int(self._first_rows[i]),
            bool(self._data.alone[i]),
            videos,
        )

    def facts(self, i: int, prefix: str = "") -> Row:
        """Return the columns of meta/episodes that begin with `prefix`, without the statistics."""
        return {
            name: column[i].as_py()
            for name, column in self._facts.items()
            if name.startswith(prefix)
        }

    def files(self) -> Iterator[str]:
        """Yield the paths in the set of all files of episodes, each once."""
        for row in self._data.rows():
            yield set_files.data_path_of(row)
        for key, (_, _, files) in self._videos.items():
            yield from (set_files.video_path_of(row, key) for row in files.rows())


class _Files:
    """Numbered files that hold the n episodes' data, or their videos of one camera."""

    def __init__(self, facts: pa.Table, prefix: str) -> None:
        chunk, file = (_numbers(facts, f"{prefix}/{name}_index") for name in ("chunk", "file"))
        both, first, of, count = np.unique(
            (chunk << 32) + file, return_index=True, return_inverse=True, return_counts=True
        )
        self._prefix, self._both = prefix, both
        self.first_episode: _Numbers = first[of]  # the first of each episode's file
        self.alone: Bool[np.ndarray, " n"] = count[of] == 1  # whether it is its file's only one

    def rows(self) -> Iterator[Row]:
        """Yield the numbers of every file, as in meta/episodes."""
        chunk, file = f"{self._prefix}/chunk_index", f"{self._prefix}/file_index"
        return ({chunk: both >> 32, file: both & 0xFFFFFFFF} for both in self._both.tolist())


def _locate_data(rows: pa.Table) -> tuple[_Numbers, _Files]:
    """Return each episode's first row in its data file, and the files."""
    lengths, first, end = (
        _numbers(rows, name) for name in ("length", "dataset_from_index", "dataset_to_index")
    )
    if len(wrong := np.flatnonzero((lengths < 1) | (end - first != lengths))):
        raise ValueError(f"episode {wrong[0]} has a wrong length")
    files = _Files(rows, "data")
    return first - first[files.first_episode], files


def _locate_videos(rows: pa.Table, key: str, fps: int) -> tuple[_Numbers, _Numbers, _Files]:
    """Return each episode's first frame in its video and number of frames, and the videos."""
    start, end = (
        _numbers(rows, f"videos/{key}/{name}_timestamp", "float64") for name in ("from", "to")
    )
    first, count = (np.rint(times * fps).astype(np.int64) for times in (start, end - start))
    return first, count, _Files(rows, f"videos/{key}")


def _in_order(table: pa.Table, n: int) -> pa.Table:
    """Return the rows of episodes 0 to n - 1; ValueError: one is missing."""
    index = _numbers(table, "episode_index")
    if len(index) < n:
        raise ValueError(f"it lists {len(index)} of {n} episodes")
    if not np.array_equal(index[:n], np.arange(n)):
        order = np.argsort(index, kind="stable")
        table, index = table.take(order), index[order]
        if len(wrong := np.flatnonzero(index[:n] != np.arange(n))):
            raise ValueError(f"it has no episode {wrong[0]}")
    return table.slice(0, n)


def _numbers(table: pa.Table, name: str, kind: str = "int64") -> np.ndarray:
    """Return a column without gaps; KeyError: there is none, ValueError: it has gaps."""
    if name not in table.column_names:
        raise KeyError(name)
    column = table[name]
    if column.null_count:
        raise ValueError(f"{name} is not known of every episode")
    return column.cast(kind).to_numpy()

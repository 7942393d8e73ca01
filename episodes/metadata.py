"""The tables under meta/ of a LeRobotDataset v3, and durable writing.

What goes beyond LeRobot are columns of meta/episodes that it ignores: `touchgoal/NAME` for the
episode's fact NAME (plain scalar or list of strings) and `videos/KEY/crc32` for the checksum of
its video.
"""

import json
import sys
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from touchgoal.control.features import FEATURES
from touchgoal.episodes.bytes_on_disk import json_bytes, parquet_bytes
from touchgoal.episodes.encoding import Description, index_columns
from touchgoal.episodes.schema import INDEX_DTYPES
from touchgoal.episodes.statistics import Stats, array_statistics, merge
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

VERSION = "v3.0"
CHUNK = 1000
META_PREFIX = "touchgoal/"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
INFO = "meta/info.json"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"
STATS = "meta/stats.json"

Row = dict[str, Any]


def repair_command(root: Path) -> str:
    """What an error message tells the user to run."""
    return f"run: touchgoal repair --fix {root}"


def set_folder(path: Path) -> Path:
    """The set in `path` or in its subfolder `episodes`, where recording commands write it.

    Says on stderr when it is the subfolder; returns `path` if neither holds a set.
    """
    inside = path / "episodes"
    if (path / INFO).exists() or not (inside / INFO).exists():
        return path
    print(f"{path} is a run folder: taking the episodes in {inside}", file=sys.stderr)
    return inside


def data_path(file_number: int) -> str:
    """Path in the set of the data file `file_number`; each holds one episode."""
    return DATA_PATH.format(chunk_index=file_number // CHUNK, file_index=file_number % CHUNK)


def video_path(key: str, file_number: int) -> str:
    """Path in the set of the video of camera `key`, file `file_number`."""
    return VIDEO_PATH.format(
        video_key=key, chunk_index=file_number // CHUNK, file_index=file_number % CHUNK
    )


def file_number_of(row: Row) -> int:
    """Number of an episode's files; repair leaves gaps, so it may exceed its position."""
    return row["data/chunk_index"] * CHUNK + row["data/file_index"]


@dataclass(frozen=True)
class SetMetadata:
    """What meta/ says of a set of episodes.

    Attributes:
        fps: frames per second.
        features: as in info.json.
        tasks: all instructions; the position is the task_index.
        stats: statistics over all frames by key.
        episodes: the table meta/episodes, one row an episode; None before the first.
    """

    fps: int
    features: dict[str, dict[str, Any]]
    tasks: tuple[str, ...] = ()
    stats: dict[str, Stats] | None = None
    episodes: pa.Table | None = None

    @property
    def n_episodes(self) -> int:
        """Number of episodes."""
        return 0 if self.episodes is None else self.episodes.num_rows

    @property
    def next_file_number(self) -> int:
        """Number of the files of the episode to come."""
        return file_number_of(last_row(self.episodes)) + 1 if self.episodes is not None else 0

    def with_episode(self, description: Description, file_number: int) -> "SetMetadata":
        """This metadata with one more episode, whose files have number `file_number`.

        Raises:
            UserError: its frame rate, features or facts differ from the set's.
        """
        self._check_same(description)
        tasks = tuple(dict.fromkeys((*self.tasks, description.task)))
        stats = description.stats | {
            key: array_statistics(column[:, None])
            for key, column in self.index_columns_for(description).items()
        }
        row = self._row(description, file_number, stats)
        schema = _schema(row) if self.episodes is None else self.episodes.schema
        if facts := _differing_facts(row, schema):
            raise UserError(
                f"the episode's meta differs from the set's in {', '.join(facts)}: give every "
                "episode of a set the same keys with the same types"
            )
        table = pa.Table.from_pylist([row], schema=schema)
        if self.episodes is not None:
            table = pa.concat_tables([self.episodes, table]).combine_chunks()
        if self.stats is not None:
            stats = {key: merge(self.stats[key], stats[key]) for key in stats}
        return replace(self, tasks=tasks, stats=stats, episodes=table)

    def index_columns_for(self, description: Description) -> dict[str, Any]:
        """The index columns of an episode that would come next."""
        before = last_row(self.episodes)
        tasks = list(dict.fromkeys((*self.tasks, description.task)))
        return index_columns(
            description.length,
            self.fps,
            episode_index=before["episode_index"] + 1 if before else 0,
            first_index=before["dataset_to_index"] if before else 0,
            task_index=tasks.index(description.task),
        )

    def _check_same(self, description: Description) -> None:
        if description.fps != self.fps:
            raise UserError(
                f"this set runs at {self.fps} frames per second, the episode at {description.fps}: "
                "record it into another folder"
            )
        ours, theirs = self.features, description.features
        differing = sorted(
            key
            for key in {*ours, *theirs}
            if _dtype_and_shape(ours.get(key)) != _dtype_and_shape(theirs.get(key))
        )
        if differing:
            raise UserError(
                f"this set has other features than the episode ({', '.join(differing)} differ in "
                "presence or shape): record it into another folder"
            )

    def _row(self, description: Description, file_number: int, stats: dict[str, Stats]) -> Row:
        before = last_row(self.episodes)
        first = before["dataset_to_index"] if before else 0
        place = {"chunk_index": file_number // CHUNK, "file_index": file_number % CHUNK}
        row: Row = {
            "episode_index": before["episode_index"] + 1 if before else 0,
            "tasks": [description.task],
            "length": description.length,
            "dataset_from_index": first,
            "dataset_to_index": first + description.length,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        row |= {f"data/{name}": value for name, value in place.items()}
        for key, crc32 in description.video_crc32.items():
            times = {"from_timestamp": 0.0, "to_timestamp": description.length / self.fps}
            values = {**place, **times, "crc32": crc32}
            row |= {f"videos/{key}/{name}": value for name, value in values.items()}
        row |= {META_PREFIX + name: value for name, value in description.meta.items()}
        for key, values in stats.items():
            row |= {f"stats/{key}/{name}": value for name, value in values.items()}
        return row

    def write(self, root: Path) -> None:
        """Writes all of meta/, each file at once and info.json, which commits, last."""
        write_file(root / EPISODES, parquet_bytes(self.episodes))
        write_file(root / STATS, json_bytes(self.stats))
        write_file(root / TASKS, parquet_bytes(_tasks_table(self.tasks)))
        write_file(root / INFO, json_bytes(self._info()))

    def _info(self) -> dict[str, Any]:
        last = last_row(self.episodes)
        videos = any(feature["dtype"] == "video" for feature in self.features.values())
        return {
            "codebase_version": VERSION,
            "robot_type": None,
            "fps": self.fps,
            "features": self.features,
            "total_episodes": last["episode_index"] + 1,
            "total_frames": last["dataset_to_index"],
            "total_tasks": len(self.tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if videos else None,
            "splits": {"train": f"0:{last['episode_index'] + 1}"},
        }

    @classmethod
    def load(cls, root: Path) -> "SetMetadata":
        """Reads all of meta/ of a set.

        Raises:
            UserError: no set, an unknown version, or a file that cannot be read.
        """
        info = load_info(root)
        return cls(
            fps=info["fps"],
            features=info["features"],
            tasks=tuple(load_table(root, TASKS)["task"].to_pylist()),
            stats=load_json(root, STATS),
            episodes=load_table(root, EPISODES),
        )


def read_video(root: Path, name: str, crc32: int) -> bytes:
    """The bytes of a video file of a set; UserError names it if it is missing or damaged."""
    try:
        video = (root / name).read_bytes()
        if zlib.crc32(video) != crc32:
            raise OSError("its checksum is not the recorded one")
    except OSError as error:
        raise unreadable(root, name, error) from error
    return video


_NEEDED = "fps", "features", "total_episodes", "total_frames", "total_tasks"


def load_info(root: Path) -> dict[str, Any]:
    """Reads meta/info.json.

    Raises:
        UserError: no set, or one of another version.
    """
    if not (root / INFO).exists():
        raise UserError(
            f"{root} is not a set of episodes (it has no {INFO}): give the folder that a recording "
            f"command wrote; if a first recording was interrupted there, {repair_command(root)}"
        )
    info = load_json(root, INFO)
    check_version(root, info)
    if missing := [key for key in _NEEDED if key not in info]:
        raise UserError(
            f"{root / INFO} is corrupt (it has no {missing[0]}): {repair_command(root)}"
        )
    return info


def check_version(root: Path, info: dict[str, Any]) -> None:
    """Raises UserError if info.json says another version than `VERSION`."""
    if (version := info.get("codebase_version")) != VERSION:
        raise UserError(
            f"{root} is of LeRobot version {version!r}, touchgoal reads {VERSION}: convert it with "
            "lerobot"
        )


def load_json(root: Path, name: str) -> dict[str, Any]:
    """Reads a JSON file of a set; UserError names it if it is missing or broken."""
    try:
        return json.loads((root / name).read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise unreadable(root, name, error) from error


def load_table(root: Path, name: str, leave_out: str | None = None) -> pa.Table:
    """Reads a Parquet file of a set, without the columns that begin with `leave_out`.

    Raises:
        UserError: the file is missing or broken.
    """
    try:
        with pq.ParquetFile(root / name) as file:
            names = file.schema_arrow.names
            kept = [n for n in names if leave_out is None or not n.startswith(leave_out)]
            return file.read(kept).combine_chunks()
    except (OSError, pa.ArrowException) as error:
        raise unreadable(root, name, error) from error


def unreadable(root: Path, name: str, error: Exception) -> UserError:
    """The error, in one line, that the file `name` of a set is missing or broken."""
    if isinstance(error, FileNotFoundError):
        return UserError(f"{root / name} is missing: {repair_command(root)}")
    reason = str(error).splitlines()[0]
    return UserError(f"{root / name} is corrupt ({reason}): {repair_command(root)}")


def refuse_other_writers(root: Path, features: dict[str, Any], episodes: pa.Table | None) -> None:
    """Raises UserError if lerobot wrote the set or added episodes to it.

    touchgoal writes one file under meta/episodes and one data file an episode, with checksums; lerobot
    puts several episodes into a file and begins further files.

    Args:
        root: folder of the set.
        features: as in info.json.
        episodes: the table meta/episodes; None if it cannot be read.
    """
    listed = (root / "meta/episodes").rglob("*.parquet")
    if others := sorted(path for path in listed if path != root / EPISODES):
        raise written_by_others(root, others[0])
    if not set(features) <= {*FEATURES, *INDEX_DTYPES}:
        raise written_by_others(root, root / INFO)
    if episodes is None:
        return
    places = episodes.select(["data/chunk_index", "data/file_index"]).to_pylist()
    cameras = [key for key, feature in features.items() if feature["dtype"] == "video"]
    unchecked = any(f"videos/{key}/crc32" not in episodes.column_names for key in cameras)
    if unchecked or len({file_number_of(row) for row in places}) < len(places):
        raise written_by_others(root, root / EPISODES)


def written_by_others(root: Path, path: Path) -> UserError:
    """The error that a set holds a file that touchgoal did not write."""
    return UserError(
        f"{root} holds episodes that lerobot wrote (see {path}); touchgoal reads only its own and "
        "changes nothing here: use the set with lerobot, or append its episodes to a new set with "
        "touchgoal's EpisodeWriter (docs/data_format.md)"
    )


def last_row(table: pa.Table | None) -> Row:
    """The last row of meta/episodes without statistics, or {} of no table."""
    if table is None:
        return {}
    names = [name for name in table.column_names if not name.startswith("stats/")]
    return table.select(names).slice(table.num_rows - 1).to_pylist()[0]


def _dtype_and_shape(feature: dict[str, Any] | None) -> Any:
    return feature and (feature["dtype"], feature["shape"])


def _differing_facts(row: Row, schema: pa.Schema) -> list[str]:
    """Facts that only one of the two has, or that have another type."""
    ours = _schema(row)
    names = {*ours.names, *schema.names}
    same = {
        n for n in {*ours.names} & {*schema.names} if ours.field(n).type == schema.field(n).type
    }
    return sorted(name.removeprefix(META_PREFIX) for name in names - same)


def _schema(row: Row) -> pa.Schema:
    return pa.schema([(name, _arrow_type(value)) for name, value in row.items()])


def _arrow_type(value: Any) -> pa.DataType:
    if isinstance(value, list):
        return pa.list_(_arrow_type(value[0]) if value else pa.string())
    types = {str: pa.string(), bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    return next(types[kind] for kind in types if isinstance(value, kind))


def _tasks_table(tasks: tuple[str, ...]) -> pa.Table:
    """LeRobot reads tasks with pandas and wants `task` as the index, which pandas finds here."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": list(tasks)})
    column = {"metadata": None}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            column
            | {"name": "task_index", "field_name": "task_index"}
            | {"pandas_type": "int64", "numpy_type": "int64"},
            column
            | {"name": "task", "field_name": "task"}
            | {"pandas_type": "unicode", "numpy_type": "object"},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({b"pandas": json.dumps(pandas).encode()})

"""The files under meta/ of a LeRobotDataset v3.

Columns of meta/episodes beyond LeRobot's, which ignores them: `touchgoal/NAME` for the entry NAME of an
episode's `meta` (scalar or list of strings), `videos/KEY/crc32` for the checksum of its video.
"""

import io
import json
import sys
import zlib
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from touchgoal.control.features import FEATURES
from touchgoal.episodes.encoding import Description, has_description, index_columns
from touchgoal.episodes.schema import INDEX_DTYPES, drop_pixel_format
from touchgoal.episodes.statistics import Stats, array_statistics, merge
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import parse_json

VERSION = "v3.0"
CHUNK = 1000
META_PREFIX = "touchgoal/"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
INFO = "meta/info.json"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
TASKS = "meta/tasks.parquet"
STATS = "meta/stats.json"
_COUNTS = {"fps": 1, "total_episodes": 0, "total_frames": 0, "total_tasks": 0}  # least values

Row = dict[str, Any]


def repair_command(root: Path) -> str:
    """Return the advice of an error message to repair a set."""
    return f"run: touchgoal repair --fix {root}"


def set_folder(path: Path) -> Path:
    """Return the folder of a set: `path`, or its `episodes/` where it is a run folder (noted on stderr)."""
    inside = path / "episodes"
    if (path / INFO).exists() or not inside.is_dir():
        return path
    print(f"{path} is a run folder: taking the episodes in {inside}", file=sys.stderr)
    return inside


def data_path(file_number: int) -> str:
    """Return the path in the set of a data file, which holds one episode."""
    return DATA_PATH.format(chunk_index=file_number // CHUNK, file_index=file_number % CHUNK)


def video_path(key: str, file_number: int) -> str:
    """Return the path in the set of a video of camera `key`."""
    return VIDEO_PATH.format(
        video_key=key, chunk_index=file_number // CHUNK, file_index=file_number % CHUNK
    )


def file_number_of(row: Row) -> int:
    """Return the number of an episode's files; after a repair it may exceed the episode's index."""
    return row["data/chunk_index"] * CHUNK + row["data/file_index"]


@dataclass(frozen=True)
class SetMetadata:
    """Content of meta/.

    Attributes:
        fps: Frames per second.
        features: As in info.json.
        tasks: All instructions; the position is the task_index.
        stats: Statistics over all frames by key.
        episodes: Table meta/episodes, one row an episode; None before the first.
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
        """Number of the next episode's files."""
        return file_number_of(last_row(self.episodes)) + 1 if self.episodes is not None else 0

    def with_episode(self, description: Description, file_number: int) -> "SetMetadata":
        """Return this metadata with one more episode, whose files have number `file_number`.

        Raises:
            UserError: Its frame rate, features or meta keys differ from the set's.
        """
        self._check_same(description)
        tasks = tuple(dict.fromkeys((*self.tasks, description.task)))
        stats = description.stats | {
            key: array_statistics(column[:, None])
            for key, column in self.index_columns_for(description).items()
        }
        row = self._row(description, file_number, stats)
        schema = _schema(row) if self.episodes is None else self.episodes.schema
        if differing := _differing_meta(row, schema):
            raise UserError(
                f"the episode's meta differs from the set's in {', '.join(differing)}: give every "
                "episode of a set the same keys with the same types"
            )
        table = pa.Table.from_pylist([row], schema=schema)
        if self.episodes is not None:
            table = pa.concat_tables([self.episodes, table]).combine_chunks()
        if self.stats is not None:
            stats = {key: merge(self.stats[key], stats[key]) for key in stats}
        return replace(self, tasks=tasks, stats=stats, episodes=table)

    def index_columns_for(self, description: Description) -> dict[str, Any]:
        """Return the index columns of an episode that would come next."""
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
        """Write all of meta/, each file atomically and info.json, which commits, last."""
        write_file(root / EPISODES, _parquet(self.episodes))
        write_file(root / STATS, _json(self.stats))
        write_file(root / TASKS, _parquet(_tasks_table(self.tasks)))
        write_file(root / INFO, _json(self.info()))

    def info(self) -> dict[str, Any]:
        """Return the content of info.json."""
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
        """Read all of meta/.

        Raises:
            UserError: No set, an unknown version, or a file that cannot be read.
        """
        info = load_info(root)
        return cls(
            fps=info["fps"],
            features=info["features"],
            tasks=tuple(load_table(root, TASKS)["task"].to_pylist()),
            stats=load_json(root, STATS),
            episodes=load_table(root, EPISODES),
        )


def _parquet(table: pa.Table | None) -> bytes:
    file = io.BytesIO()
    pq.write_table(table, file, write_page_checksum=True)
    return file.getvalue()


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=1, allow_nan=False).encode()


def read_video(root: Path, name: str, crc32: int) -> bytes:
    """Return the bytes of a video file of a set; UserError if it is missing or damaged."""
    try:
        video = (root / name).read_bytes()
        if zlib.crc32(video) != crc32:
            raise OSError("its checksum is not the recorded one")
    except OSError as error:
        raise unreadable(root, name, error) from error
    return video


def load_info(root: Path) -> dict[str, Any]:
    """Read meta/info.json.

    Raises:
        UserError: No set, one of another version, or a value that cannot be.
    """
    if not (root / INFO).exists():
        raise UserError(
            f"{root} is not a set of episodes (it has no {INFO}): give the folder that a recording "
            f"command wrote; if a first recording was interrupted there, {repair_command(root)}"
        )
    info = load_json(root, INFO)
    check_version(root, info)
    features = info.get("features")
    sound = isinstance(features, dict) and all(
        isinstance(f, dict) and isinstance(f.get("dtype"), str) and isinstance(f.get("shape"), list)
        for f in features.values()
    )
    wrong = [] if sound else ["features"]
    for key, least in _COUNTS.items():
        if type(value := info.get(key)) is not int or value < least:
            wrong.append(f"{key} = {value!r}")
    if wrong:
        raise unreadable(root, INFO, ValueError(f"wrong {', '.join(wrong)}"))
    drop_pixel_format(info["features"])
    return info


def check_version(root: Path, info: dict[str, Any]) -> None:
    """Raise UserError if info.json names another version than `VERSION`."""
    if (version := info.get("codebase_version")) != VERSION:
        raise UserError(
            f"{root} is of LeRobot version {version!r}, touchgoal reads {VERSION}: convert it with "
            "lerobot"
        )


def load_json(root: Path, name: str) -> dict[str, Any]:
    """Read a JSON object of a set; UserError if it is missing or broken."""
    try:
        if not isinstance(value := parse_json((root / name).read_bytes()), dict):
            raise ValueError("it holds no object")
        return value
    except (OSError, ValueError) as error:
        raise unreadable(root, name, error) from error


def load_table(root: Path, name: str, leave_out: str | None = None) -> pa.Table:
    """Read a Parquet file of a set, without the columns that begin with `leave_out`.

    Raises:
        UserError: The file is missing or broken.
    """
    try:
        with pq.ParquetFile(root / name, page_checksum_verification=True) as file:
            names = file.schema_arrow.names
            columns = [n for n in names if leave_out is None or not n.startswith(leave_out)]
            return file.read(columns).combine_chunks()
    except (OSError, pa.ArrowException) as error:
        raise unreadable(root, name, error) from error


def unreadable(root: Path, name: str, error: Exception) -> UserError:
    """Return the error that the file `name` of a set is missing or broken."""
    if isinstance(error, FileNotFoundError):
        return UserError(f"{root / name} is missing: {repair_command(root)}")
    reason = str(error).splitlines()[0]
    return UserError(f"{root / name} is corrupt ({reason}): {repair_command(root)}")


def refuse_other_writers(root: Path, features: dict[str, Any], episodes: pa.Table | None) -> None:
    """Raise UserError if lerobot wrote the set or added episodes to it.

    touchgoal writes one file under meta/episodes, and one data file an episode with a description in
    its footer; lerobot puts several episodes into a file and begins further files.

    Args:
        root: Folder of the set.
        features: As in info.json.
        episodes: Table meta/episodes; None if it cannot be read.
    """
    listed = (root / "meta/episodes").rglob("*.parquet")
    if others := sorted(path for path in listed if path != root / EPISODES):
        raise written_by_others(root, others[0])
    if unknown := sorted(set(features) - {*FEATURES, *INDEX_DTYPES}):
        refuse_foreign_data_files(root, if_none=root / INFO)
        raise unreadable(root, INFO, ValueError(f"unknown feature {unknown[0]!r}"))
    if episodes is None:
        return
    places = episodes.select(["data/chunk_index", "data/file_index"]).to_pylist()
    cameras = [key for key, feature in features.items() if feature["dtype"] == "video"]
    unchecked = any(f"videos/{key}/crc32" not in episodes.column_names for key in cameras)
    if unchecked or len({file_number_of(row) for row in places}) < len(places):
        refuse_foreign_data_files(root, if_none=root / EPISODES)
        raise unreadable(root, EPISODES, ValueError("wrong places of files"))


def refuse_foreign_data_files(root: Path, if_none: Path | None = None) -> None:
    """Raise UserError if touchgoal did not write one of the data files that can be read.

    Args:
        root: Folder of the set.
        if_none: File that is blamed where no data file can be read; None to allow that.
    """
    own = False
    for path in sorted((root / "data").rglob("*.parquet")):
        with suppress(OSError, pa.ArrowException), pq.ParquetFile(path) as file:
            if not has_description(file):
                raise written_by_others(root, path)
            own = True
    if not own and if_none is not None:
        raise written_by_others(root, if_none)


def written_by_others(root: Path, path: Path) -> UserError:
    """Return the error that touchgoal did not write a file of a set."""
    return UserError(
        f"{root} holds episodes that lerobot wrote (see {path}); touchgoal reads only its own and "
        "changes nothing here: use the set with lerobot, or append its episodes to a new set with "
        "touchgoal's EpisodeWriter (docs/data_format.md)"
    )


def last_row(table: pa.Table | None) -> Row:
    """Return the last row of meta/episodes without statistics, or {} without a table."""
    if table is None:
        return {}
    names = [name for name in table.column_names if not name.startswith("stats/")]
    return table.select(names).slice(table.num_rows - 1).to_pylist()[0]


def _dtype_and_shape(feature: dict[str, Any] | None) -> Any:
    return feature and (feature["dtype"], feature["shape"])


def _differing_meta(row: Row, schema: pa.Schema) -> list[str]:
    """Return the meta keys that only one of the two has, or that have another type."""
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
    """Return meta/tasks with pandas' metadata: LeRobot reads it with pandas and expects `task` as index."""
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

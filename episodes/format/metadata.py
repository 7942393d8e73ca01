"""The files under meta/ of a LeRobotDataset v3.

Columns of meta/episodes beyond LeRobot's, which ignores them: `touchgoal/NAME` for the entry NAME of an
episode's `meta` (scalar or list of strings), `videos/KEY/crc32` for the checksum of its video. An append
rewrites the last file of meta/episodes alone, which holds at most `CHUNK` rows: it costs the same in a set of any
size, unless its `meta` has a new key.
"""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped

from touchgoal.control.features import ACTION
from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.encoding import Description
from touchgoal.episodes.format.set_files import Row
from touchgoal.episodes.format.statistics import Stats, array_statistics, merge
from touchgoal.episodes.schema import INDEX_DTYPES
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

_OWN = {b"touchgoal": b"episodes"}  # footer by which a file is recognised, see `foreign`


@dataclass(frozen=True)
class SetMetadata:
    """Content of meta/."""

    fps: int  # frames per second
    features: dict[str, dict[str, Any]]  # as in info.json
    tasks: tuple[str, ...] = ()  # all instructions; the position is the task_index
    stats: dict[str, Stats] | None = None  # statistics over all frames by key
    files: tuple[pa.Table, ...] = ()  # meta/episodes, a row per episode, at most CHUNK per file

    @property
    def n_episodes(self) -> int:
        """Number of episodes."""
        return sum(table.num_rows for table in self.files)

    @property
    def _last(self) -> Row:
        """Row of the last episode without statistics; {} before the first."""
        return set_files.last_row(self.files[-1]) if self.files else {}

    @property
    def _next_file(self) -> int:
        """Number of the file of meta/episodes that takes the next row."""
        full = not self.files or self.files[-1].num_rows >= set_files.CHUNK
        return len(self.files) - (not full)

    @property
    def next_file_number(self) -> int:
        """Number of the next episode's files."""
        return set_files.file_number_of(self._last) + 1 if self.files else 0

    def with_episode(self, description: Description, file_number: int) -> "SetMetadata":
        """Return this metadata with one more episode, whose files have number `file_number`.

        Meta that only some episodes have is null in the others. UserError: its frame rate, features or
        types of meta differ from the set's.
        """
        self._check_same(description)
        tasks = tuple(dict.fromkeys((*self.tasks, description.task)))
        stats = description.stats | {
            key: array_statistics(column[:, None])
            for key, column in self.index_columns_for(description).items()
        }
        row = self._row(description, file_number, stats)
        files = [_with_columns(table, _schema(row)) for table in self.files]
        schema = files[-1].schema if files else _schema(row)
        full, begun = files[: self._next_file], files[self._next_file :]
        table = pa.concat_tables([*begun, pa.Table.from_pylist([row], schema=schema)])
        if self.stats is not None:
            stats = {key: merge(self.stats[key], stats[key]) for key in stats}
        return replace(self, tasks=tasks, stats=stats, files=(*full, table.combine_chunks()))

    def index_columns_for(self, description: Description) -> dict[str, Shaped[np.ndarray, " n"]]:
        """Return LeRobot's index columns of an episode that would come next.

        Time stamps are exactly frame_index / fps seconds.
        """
        before, frame = self._last, np.arange(description.length)
        tasks = list(dict.fromkeys((*self.tasks, description.task)))
        columns = {
            "timestamp": frame / self.fps,
            "frame_index": frame,
            "episode_index": np.full_like(frame, before["episode_index"] + 1 if before else 0),
            "index": frame + (before["dataset_to_index"] if before else 0),
            "task_index": np.full_like(frame, tasks.index(description.task)),
        }
        return {key: columns[key].astype(dtype) for key, dtype in INDEX_DTYPES.items()}

    def _check_same(self, description: Description) -> None:
        if description.fps != self.fps:
            raise UserError(
                f"this set runs at {self.fps} frames per second, the episode at {description.fps}: "
                "record it into another folder"
            )
        if differing := differing_features(self.features, description.features):
            raise UserError(
                f"this set has other features than the episode ({', '.join(differing)} differ in "
                "presence or shape): record it into another folder"
            )

    def check_fits(self, root: Path, shapes: Mapping[str, tuple[int, ...]], task: str) -> None:
        """Raise UserError if episodes to come would not fit the set in `root`.

        `shapes` are those of every observation and of the action at one frame; `task` is its name in meta.
        """
        there = {
            key: tuple(feature["shape"])
            for key, feature in self.features.items()
            if key == ACTION or key.startswith("observation.")
        }
        for key in sorted({*there, *shapes}):
            mine, theirs = (s.get(key, "absent") for s in (there, shapes))
            if mine != theirs:
                raise UserError(
                    f"{key} is {mine} in {root} and {theirs} in the episodes to come: give the "
                    "options that the set was recorded with, or record into another folder"
                )
        name = set_files.META_PREFIX + "task"
        if self.files and name in self.files[0].column_names:
            if others := {t for table in self.files for t in table[name].to_pylist()} - {task}:
                raise UserError(
                    f"{root} holds {min(others)}, not {task}: record into another folder"
                )

    def _row(self, description: Description, file_number: int, stats: dict[str, Stats]) -> Row:
        before = self._last
        first = before["dataset_to_index"] if before else 0
        chunk, file = divmod(file_number, set_files.CHUNK)
        place = {"chunk_index": chunk, "file_index": file}
        listed_in = divmod(self._next_file, set_files.CHUNK)
        row: Row = {
            "episode_index": before["episode_index"] + 1 if before else 0,
            "tasks": [description.task],
            "length": description.length,
            "dataset_from_index": first,
            "dataset_to_index": first + description.length,
            "meta/episodes/chunk_index": listed_in[0],
            "meta/episodes/file_index": listed_in[1],
        }
        row |= {f"data/{name}": value for name, value in place.items()}
        for key, crc32 in description.video_crc32.items():
            times = {"from_timestamp": 0.0, "to_timestamp": description.length / self.fps}
            values = {**place, **times, "crc32": crc32}
            row |= {f"videos/{key}/{name}": value for name, value in values.items()}
        row |= {set_files.META_PREFIX + name: value for name, value in description.meta.items()}
        for key, values in stats.items():
            row |= {f"stats/{key}/{name}": value for name, value in values.items()}
        return row

    def write(self, root: Path, there: Sequence[pa.Table] = ()) -> None:
        """Write meta/, each file atomically; info.json comes last and commits the change.

        `there` are the files of meta/episodes that are in the folder; what did not change is left.
        """
        for number, table in enumerate(self.files):
            if number < len(there) and there[number] is table:
                continue
            marked = table.replace_schema_metadata(_OWN)
            write_file(root / set_files.episodes_path(number), _parquet(marked))
        write_file(root / set_files.STATS, _json(self.stats))
        write_file(root / set_files.TASKS, _parquet(_tasks_table(self.tasks)))
        write_file(root / set_files.INFO, _json(self.info()))

    def info(self) -> dict[str, Any]:
        """Return the content of info.json."""
        last = self._last
        videos = any(feature["dtype"] == "video" for feature in self.features.values())
        return {
            "codebase_version": set_files.VERSION,
            "robot_type": None,
            "fps": self.fps,
            "features": self.features,
            "total_episodes": last["episode_index"] + 1,
            "total_frames": last["dataset_to_index"],
            "total_tasks": len(self.tasks),
            "chunks_size": set_files.CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": set_files.DATA_PATH,
            "video_path": set_files.VIDEO_PATH if videos else None,
            "splits": {"train": f"0:{last['episode_index'] + 1}"},
        }

    @classmethod
    def load(cls, root: Path) -> "SetMetadata":
        """Read all of meta/.

        UserError: no set, an unknown version, or a file that is missing or cannot be read.
        """
        info, names = set_files.load_info(root), set_files.episodes_files(root)
        for name in map(set_files.episodes_path, range(len(names))):
            if name not in names:
                raise set_files.unreadable(root, name, FileNotFoundError())
        return cls(
            fps=info["fps"],
            features=info["features"],
            tasks=tuple(set_files.read_parquet(root, set_files.TASKS)["task"].to_pylist()),
            stats=set_files.load_json(root, set_files.STATS),
            files=tuple(set_files.read_parquet(root, name) for name in names),
        )


def _parquet(table: pa.Table) -> bytes:
    file = io.BytesIO()
    pq.write_table(table, file, write_page_checksum=True)
    return file.getvalue()


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=1, allow_nan=False).encode()


def differing_features(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> list[str]:
    """Return the keys that only one of two sets has, or whose dtype or shape differ."""
    first, second = (
        {key: (feature["dtype"], feature["shape"]) for key, feature in features.items()}
        for features in (ours, theirs)
    )
    return sorted(key for key in {*ours, *theirs} if first.get(key) != second.get(key))


def _with_columns(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return a table with the columns of a schema that it lacks, null; UserError: a type differs."""
    other = [
        n
        for n in schema.names
        if n in table.column_names and schema.field(n).type != table.schema.field(n).type
    ]
    if other:
        names = ", ".join(name.removeprefix(set_files.META_PREFIX) for name in other)
        raise UserError(
            f"the episode's meta differs from the set's in {names}: give a key the same type in every "
            "episode of a set"
        )
    if set(schema.names) <= set(table.column_names):
        return table
    return pa.concat_tables([table, schema.empty_table()], promote_options="default")


def _schema(row: Row) -> pa.Schema:
    types = {name: pa.infer_type([value]) for name, value in row.items()}
    empty, texts = pa.list_(pa.null()), pa.list_(pa.string())
    return pa.schema([(name, texts if found == empty else found) for name, found in types.items()])


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

"""Files of a set of episodes: their paths, reading them, and errors that name the file."""

import sys
import zlib
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from touchgoal.control.sensors.clip import refuse_other_format
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import parse_json

VERSION = "v3.0"
CHUNK = 1000
META_PREFIX = "touchgoal/"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
INFO = "meta/info.json"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"  # the first of its files
TASKS = "meta/tasks.parquet"
STATS = "meta/stats.json"
# Keys and their least values.
_COUNTS = {"fps": 1, "total_episodes": 0, "total_frames": 0, "total_tasks": 0}

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


def episodes_path(number: int) -> str:
    """Return the path in the set of a file of meta/episodes, counted from 0."""
    return f"meta/episodes/chunk-{number // CHUNK:03d}/file-{number % CHUNK:03d}.parquet"


def episodes_files(root: Path) -> list[str]:
    """Return the paths in the set of the files of meta/episodes; of the first if there is none yet."""
    paths = sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet"))
    return [path.relative_to(root).as_posix() for path in paths] or [EPISODES]


def data_path_of(row: Row) -> str:
    """Return the path in the set of the data file that holds an episode of meta/episodes."""
    return DATA_PATH.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])


def video_path_of(row: Row, key: str) -> str:
    """Return the path in the set of the video that holds camera `key` of an episode."""
    return VIDEO_PATH.format(
        video_key=key,
        chunk_index=row[f"videos/{key}/chunk_index"],
        file_index=row[f"videos/{key}/file_index"],
    )


def file_number_of(row: Row) -> int:
    """Return the number of an episode's files; after a repair it may exceed the episode's index."""
    return row["data/chunk_index"] * CHUNK + row["data/file_index"]


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
    """Read meta/info.json. UserError: no set, another version, or an impossible value."""
    if not (root / INFO).exists():
        refuse_other_format(root)
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
    if isinstance(fps := info.get("fps"), float) and fps.is_integer():
        info["fps"] = int(fps)
    wrong = [] if sound else ["features"]
    for key, least in _COUNTS.items():
        if type(value := info.get(key)) is not int or value < least:
            wrong.append(f"{key} = {value!r}")
    if wrong:
        raise unreadable(root, INFO, ValueError(f"wrong {', '.join(wrong)}"))
    _check_paths(root, info)
    return info


def _check_paths(root: Path, info: dict[str, Any]) -> None:
    """Raise UserError unless paths are LeRobot's defaults, filled in with keys that are plain names."""
    for name, usual in (("data_path", DATA_PATH), ("video_path", VIDEO_PATH)):
        if info.get(name) not in (None, usual):
            raise UserError(f"{root / INFO}: {name} is {info[name]!r}; touchgoal reads {usual!r}")
    for key in info["features"]:
        if set(key) & set("/\\\0") or key in ("", ".", ".."):
            raise unreadable(root, INFO, ValueError(f"{key!r} cannot name a feature"))


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


def read_parquet(root: Path, name: str, leave_out: str | None = None) -> pa.Table:
    """Read a Parquet file of a set, without the columns that begin with `leave_out`.

    UserError: the file is missing or broken.
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


def last_row(table: pa.Table) -> Row:
    """Return the last row of meta/episodes without statistics."""
    names = [name for name in table.column_names if not name.startswith("stats/")]
    return table.select(names).slice(table.num_rows - 1).to_pylist()[0]

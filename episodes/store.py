"""Sets of episodes on disk: LeRobotDataset v3, written and read without lerobot.

Every episode has its own data file and its own videos, numbered by the same number; an append
writes them first and then everything under meta/, each file in one atomic step, info.json last.
So a set holds what its info.json says, and a process killed at any moment leaves at most the files
of the episode in progress, which `repair` takes in (if complete) or moves aside.
"""

import itertools
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8
from tqdm import tqdm

from touchgoal.control.errors import UserError
from touchgoal.control.features import FEATURES
from touchgoal.episodes import metadata
from touchgoal.episodes.encoding import (
    Description,
    EncodedEpisode,
    data_file,
    encode,
    read_columns,
    read_description,
    write_table,
)
from touchgoal.episodes.media import decode_video
from touchgoal.episodes.metadata import Row, SetMetadata
from touchgoal.episodes.schema import INDEX_DTYPES, Episode, MetaValue, is_camera

REPAIRED = "repaired"
_FOLDERS = ("data", "videos", "meta")
_META = (metadata.INFO, metadata.EPISODES, metadata.TASKS, metadata.STATS)
_DATA_FILES = "chunk-[0-9][0-9][0-9]/file-[0-9][0-9][0-9].parquet"


class EpisodeWriter:
    """Appends episodes to a set, new or continued; one writer at a time.

    The first episode fixes the features, picture sizes and meta keys of a new set.
    """

    def __init__(self, root: str | os.PathLike[str], fps: int = 20) -> None:
        """Opens a set for appending; nothing is written before the first `append`.

        Args:
            root: folder of the set; made if it is not there.
            fps: frames per second of the episodes to come.

        Raises:
            UserError: a continued set runs at another rate, was interrupted or is damaged.
        """
        self._root = Path(root)
        self._fps = fps
        self._metadata: SetMetadata | None = None
        if (self._root / metadata.INFO).exists():
            self._metadata = SetMetadata.load(self._root)
            if self._metadata.fps != fps:
                raise UserError(
                    f"{root} runs at {self._metadata.fps} frames per second, not {fps}: continue "
                    "it at its own rate or record into another folder"
                )
        problems = _contradictions_in_meta(self._root, self._metadata) if self._metadata else []
        if problems := problems or _unlisted_files(self._root, self._metadata):
            raise UserError(f"{root} was interrupted (see {problems[0]}): {metadata.REPAIR}")

    def __len__(self) -> int:
        """Number of episodes in the set."""
        return 0 if self._metadata is None else _n_episodes(self._metadata)

    def append(self, episode: Episode | EncodedEpisode) -> int:
        """Adds an episode; when this returns, it is on disk for good.

        Returns:
            The episode's index in the set.

        Raises:
            UserError: the episode is unsound or does not fit the set, which stays as it was; or
                another process writes to the set.
        """
        encoded = encode(episode, self._fps) if isinstance(episode, Episode) else episode
        description = encoded.description
        current = self._metadata or SetMetadata(self._fps, description.features)
        file_number = current.next_file_number
        updated = current.with_episode(description, file_number)
        if (path := self._root / metadata.data_path(file_number)).exists():
            raise UserError(
                f"{path} appeared while recording: let only one process write to a set, then "
                f"{metadata.REPAIR}"
            )
        for key, video in encoded.videos.items():
            metadata.write_file(self._root / metadata.video_path(key, file_number), video)
        metadata.write_file(path, data_file(encoded, current.index_columns_for(description)))
        updated.write(self._root)
        self._metadata = updated
        return len(self) - 1


class EpisodeSet:
    """A set of episodes for reading: what it held when opened."""

    def __init__(self, root: str | os.PathLike[str]) -> None:
        """Opens a set.

        Raises:
            UserError: not a set, an unknown version, or made by others in a way touchgoal does not
                read; a metadata file is missing or corrupt.
        """
        self.root = Path(root)
        info = metadata.load_info(self.root)
        self.fps: int = info["fps"]
        self.features: dict[str, dict[str, Any]] = {
            key: feature for key, feature in info["features"].items() if key not in INDEX_DTYPES
        }
        table = metadata.load_table(self.root, metadata.EPISODES, leave_out="stats/")
        self._rows: list[Row] = table.slice(0, info["total_episodes"]).to_pylist()
        if len(self._rows) < info["total_episodes"]:
            raise UserError(
                f"{self.root / metadata.EPISODES} lists {len(self._rows)} of "
                f"{info['total_episodes']} episodes: {metadata.REPAIR}"
            )
        self._refuse_sets_of_others(table.column_names)

    def _refuse_sets_of_others(self, columns: list[str]) -> None:
        several = len({metadata.file_number_of(row) for row in self._rows}) < len(self._rows)
        unchecked = any(f"videos/{k}/crc32" not in columns for k in _cameras(self.features))
        if several or unchecked or not set(self.features) <= set(FEATURES):
            raise UserError(
                f"{self.root} is a LeRobot set that touchgoal did not write: read its episodes "
                "with lerobot and append them with touchgoal's EpisodeWriter"
            )

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self._rows)

    @property
    def lengths(self) -> list[int]:
        """Number of frames of every episode."""
        return [row["length"] for row in self._rows]

    def meta(self, i: int) -> dict[str, MetaValue]:
        """The facts about episode i."""
        prefix = metadata.META_PREFIX
        row = self._row(i)
        return {k.removeprefix(prefix): v for k, v in row.items() if k.startswith(prefix)}

    def task(self, i: int) -> str:
        """The instruction of episode i."""
        return self._row(i)["tasks"][0]

    def read(
        self, i: int, keys: Sequence[str] | None = None, frames: Sequence[int] | None = None
    ) -> Episode:
        """Reads episode i; only what is asked for is decoded.

        Args:
            i: index of the episode.
            keys: the keys to read; None for all.
            frames: indices of the frames to read, in the order wanted; None for all.

        Raises:
            UserError: no such episode, key or frame; a file is missing or corrupt.
        """
        row = self._row(i)
        keys = list(self.features) if keys is None else keys
        if unknown := [key for key in keys if key not in self.features]:
            raise UserError(f"{self.root} has no {unknown[0]}; it has {', '.join(self.features)}")
        wanted = np.arange(row["length"]) if frames is None else np.asarray(frames, np.int64)
        outside = wanted[(wanted < 0) | (wanted >= row["length"])]
        if len(outside):
            raise UserError(
                f"episode {i} of {self.root} has frames 0 to {row['length'] - 1}, not {outside[0]}"
            )
        columns = {key: self.features[key] for key in keys if not is_camera(key)}
        read = self._read_data(row, columns, wanted) if columns else {}
        read |= {key: self._read_video(row, key, wanted) for key in keys if is_camera(key)}
        return Episode({key: read[key] for key in keys}, self.task(i), self.meta(i))

    def _row(self, i: int) -> Row:
        if not 0 <= i < len(self):
            raise UserError(f"{self.root} has episodes 0 to {len(self) - 1}, not {i}")
        return self._rows[i]

    def _read_data(
        self, row: Row, features: dict[str, dict[str, Any]], frames: np.ndarray
    ) -> dict[str, np.ndarray]:
        path = self.root / metadata.data_path(metadata.file_number_of(row))
        try:
            with pq.ParquetFile(path, page_checksum_verification=True) as file:
                if file.metadata.num_rows != row["length"]:
                    raise OSError(f"{file.metadata.num_rows} frames instead of {row['length']}")
                return read_columns(file, features, frames)
        except (OSError, pa.ArrowException) as error:
            raise metadata.unreadable(path, error) from error

    def _read_video(self, row: Row, key: str, frames: np.ndarray) -> UInt8[np.ndarray, "n h w 3"]:
        path = self.root / metadata.video_path(key, metadata.file_number_of(row))
        video = _read_video_file(path, row[f"videos/{key}/crc32"])
        return decode_video(video, self.fps, frames.tolist())


def _read_video_file(path: Path, crc32: int) -> bytes:
    try:
        video = path.read_bytes()
        if zlib.crc32(video) != crc32:
            raise OSError("its checksum is not the recorded one")
    except OSError as error:
        raise metadata.unreadable(path, error) from error
    return video


def _n_episodes(set_metadata: SetMetadata) -> int:
    return 0 if set_metadata.episodes is None else set_metadata.episodes.num_rows


def _file_numbers(set_metadata: SetMetadata | None) -> list[int]:
    if set_metadata is None or set_metadata.episodes is None:
        return []
    names = ["data/chunk_index", "data/file_index"]
    return [metadata.file_number_of(row) for row in set_metadata.episodes.select(names).to_pylist()]


def _cameras(features: dict[str, dict[str, Any]]) -> list[str]:
    return [key for key, feature in features.items() if feature["dtype"] == "video"]


def _unlisted_files(root: Path, set_metadata: SetMetadata | None) -> list[str]:
    """Files that belong to no episode that the metadata lists, as paths in the set."""
    known = set(_META)
    cameras = _cameras(set_metadata.features) if set_metadata else []
    for file_number in _file_numbers(set_metadata):
        known |= {metadata.data_path(file_number)} | {
            metadata.video_path(k, file_number) for k in cameras
        }
    files = [path for tree in _FOLDERS for path in (root / tree).rglob("*") if path.is_file()]
    return sorted({path.relative_to(root).as_posix() for path in files} - known)


def _contradictions_in_meta(root: Path, set_metadata: SetMetadata) -> list[str]:
    """What info.json, stats.json and tasks.parquet contradict in meta/episodes."""
    info = metadata.load_info(root)
    frames = metadata.last_row(set_metadata.episodes)["dataset_to_index"]
    problems = []
    if (info["total_episodes"], info["total_frames"]) != (_n_episodes(set_metadata), frames):
        problems.append(
            f"{root / metadata.INFO} counts {info['total_episodes']} episodes, "
            f"{root / metadata.EPISODES} {_n_episodes(set_metadata)}"
        )
    if info["total_tasks"] != len(set_metadata.tasks):
        problems.append(f"{root / metadata.TASKS} has not the tasks of {root / metadata.INFO}")
    counts = {key: stats["count"] for key, stats in (set_metadata.stats or {}).items()}
    if counts != {key: [frames] for key in set_metadata.features}:
        problems.append(f"{root / metadata.STATS} is not of all {frames} frames")
    return problems


def _read_episode(root: Path, file_number: int) -> tuple[Description, pa.Table]:
    """Reads every byte of an episode's files; checksums show any damage."""
    path = root / metadata.data_path(file_number)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            description, table = read_description(file), file.read()
    except (OSError, pa.ArrowException) as error:
        raise metadata.unreadable(path, error) from error
    for key, crc32 in description.video_crc32.items():
        _read_video_file(root / metadata.video_path(key, file_number), crc32)
    return description, table


def _wrong_index_columns(table: pa.Table, indices: dict[str, np.ndarray]) -> list[str]:
    return [k for k, values in indices.items() if not np.array_equal(table[k].to_numpy(), values)]


def _refuse_sets_of_others(root: Path) -> None:
    """Repair would move aside what it does not know, so it must be sure the set is touchgoal's."""
    if not any((root / tree).is_dir() for tree in _FOLDERS):
        raise UserError(f"{root} is not a set of episodes: give the folder of one")
    if (root / metadata.INFO).exists():
        try:
            info = metadata.load_json(root, metadata.INFO)
        except UserError:
            info = {"codebase_version": metadata.VERSION}  # the data files will tell
        metadata.check_version(root, info)
    for path in sorted((root / "data").rglob("*.parquet")):
        try:
            with pq.ParquetFile(path) as file:
                read_description(file)
            return
        except (OSError, pa.ArrowException):
            continue
        except UserError as error:
            raise UserError(f"{path}: {error}; touchgoal mends only its own sets") from error


def validate(root: str | os.PathLike[str]) -> list[str]:
    """Reads every file of a set and returns what is wrong, one line a problem; [] if sound.

    Raises:
        UserError: not a set of touchgoal, or one of another version.
    """
    root = Path(root)
    _refuse_sets_of_others(root)
    try:
        set_metadata = SetMetadata.load(root)
    except UserError as error:
        return [str(error)]
    problems = _contradictions_in_meta(root, set_metadata)
    rebuilt = SetMetadata(set_metadata.fps, set_metadata.features)
    for file_number in tqdm(_file_numbers(set_metadata), desc="validate", unit="episode"):
        try:
            description, table = _read_episode(root, file_number)
            if differing := _wrong_index_columns(table, rebuilt.index_columns_for(description)):
                name = root / metadata.data_path(file_number)
                problems.append(f"{name} has wrong {', '.join(differing)}: {metadata.REPAIR}")
            rebuilt = rebuilt.with_episode(description, file_number)
        except UserError as error:
            problems.append(str(error))
    return problems + [
        f"{root / n} belongs to no episode" for n in _unlisted_files(root, set_metadata)
    ]


def repair(root: str | os.PathLike[str]) -> list[str]:
    """Makes a set sound again after a crash or damage; deletes nothing.

    Every episode whose files are whole is kept, in order; other files move to `repaired/` inside
    the set, and so does the old meta/, which is made again from the data files. May itself be
    killed and run again.

    Returns:
        What was done, one line each; [] if the set was sound.

    Raises:
        UserError: not a set of touchgoal, or one of another version.
    """
    root = Path(root)
    if not validate(root):
        return []
    done: list[str] = []
    set_metadata: SetMetadata | None = None
    for path in tqdm(sorted((root / "data").glob(_DATA_FILES)), desc="repair", unit="episode"):
        file_number = int(path.parent.name[-3:]) * metadata.CHUNK + int(path.stem[-3:])
        try:
            description, table = _read_episode(root, file_number)
            before = set_metadata or SetMetadata(description.fps, description.features)
            set_metadata = before.with_episode(description, file_number)
        except UserError as error:
            reason = str(error).removesuffix(": " + metadata.REPAIR)
            done.append(f"left out the episode of {path}: {reason}")
            continue
        if _wrong_index_columns(table, before.index_columns_for(description)):
            _rewrite_index_columns(path, description, table, before.index_columns_for(description))
            done.append(f"renumbered {path}")
    done += [_move_to_repaired(root, name) for name in _unlisted_files(root, set_metadata)]
    done += [_move_to_repaired(root, name) for name in _META if (root / name).exists()]
    if set_metadata is None:
        return [*done, f"no whole episode is left in {root}"]
    set_metadata.write(root)
    return [*done, f"wrote {root / 'meta'} again for {_n_episodes(set_metadata)} episodes"]


def _rewrite_index_columns(
    path: Path, description: Description, table: pa.Table, indices: dict[str, np.ndarray]
) -> None:
    for key, values in indices.items():
        table = table.set_column(table.column_names.index(key), key, pa.array(values))
    metadata.write_file(path, write_table(table, description))


def _move_to_repaired(root: Path, name: str) -> str:
    """Moves a file of the set into `repaired/`, beside what an earlier repair moved there."""
    target = root / REPAIRED / name
    for i in itertools.count(1):
        if not target.exists():
            break
        target = root / REPAIRED / f"{name}.{i}"
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(root / name, target)
    return f"moved {root / name} to {target}"

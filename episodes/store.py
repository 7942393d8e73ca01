"""Sets of episodes on disk: LeRobotDataset v3, written and read without lerobot.

Every episode has its own data file and its own videos, numbered by the same number; an append
writes them first and then everything under meta/, each file in one atomic step, info.json last.
A set holds what its info.json lists; a process killed at any moment leaves at most the files of the
episode in progress, which `repair` adds (if complete) or moves aside.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8

from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.encoding import EncodedEpisode, data_file, encode, read_columns
from touchgoal.episodes.format.metadata import SetMetadata
from touchgoal.episodes.format.repair import unlisted_files
from touchgoal.episodes.format.set_files import Row
from touchgoal.episodes.media import decode_video
from touchgoal.episodes.schema import INDEX_DTYPES, Episode, MetaValue, is_camera, is_image
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.folder_lock import FolderLock


class EpisodeWriter:
    """Writer that appends episodes to a new or an existing set; one at a time.

    The first episode fixes the features, image sizes and meta keys of a new set. A second writer, in
    this process or another one, is refused until this one is closed or garbage, or its process ends.
    """

    def __init__(self, root: str | os.PathLike[str], fps: int = 20) -> None:
        """Open a set for appending; no file is written before the first `append`.

        Args:
            root: Folder of the set; made if missing.
            fps: Frames per second of the episodes to come.

        Raises:
            UserError: An existing set has another rate, was interrupted, is damaged or was continued
                by lerobot; another process records into it; the folder cannot be made.
        """
        self._root = Path(root)
        self._fps = fps
        self._lock = FolderLock(self._root)
        try:
            self._metadata = self._load()
        except BaseException:
            self._lock.release()
            raise

    def _load(self) -> SetMetadata | None:
        """Return the checked metadata of the set; None before the first episode."""
        found = None
        if (self._root / set_files.INFO).exists():
            found = SetMetadata.load(self._root)
            set_files.refuse_other_writers(self._root, found.features, found.episodes)
            if found.fps != self._fps:
                raise UserError(
                    f"{self._root} runs at {found.fps} frames per second, not {self._fps}: "
                    "continue it at its own rate or record into another folder"
                )
        doubtful = unlisted_files(self._root, found)
        if found is not None:
            info, counted = set_files.load_info(self._root), found.info()
            if any(info[key] != counted[key] for key in info if key.startswith("total_")):
                doubtful.append(set_files.INFO)
        if doubtful:
            raise UserError(
                f"{self._root} was interrupted (see {doubtful[0]}): "
                f"{set_files.repair_command(self._root)}"
            )
        return found

    def __len__(self) -> int:
        return 0 if self._metadata is None else self._metadata.n_episodes

    def close(self) -> None:
        """Release the set for another writer."""
        self._lock.release()

    def append(self, episode: Episode | EncodedEpisode) -> int:
        """Add an episode; when this returns, it is on disk.

        Returns:
            The episode's index in the set.

        Raises:
            UserError: The episode is unsound or does not fit the set, which stays as it was; or
                another process writes to the set.
        """
        encoded = encode(episode, self._fps) if isinstance(episode, Episode) else episode
        description = encoded.description
        current = self._metadata or SetMetadata(self._fps, description.features)
        file_number = current.next_file_number
        updated = current.with_episode(description, file_number)
        if (path := self._root / set_files.data_path(file_number)).exists():
            raise UserError(
                f"{path} appeared while recording: let only one process write to a set, then "
                f"{set_files.repair_command(self._root)}"
            )
        for key, video in encoded.videos.items():
            write_file(self._root / set_files.video_path(key, file_number), video)
        write_file(path, data_file(encoded, current.index_columns_for(description)))
        updated.write(self._root)
        self._metadata = updated
        return len(self) - 1


class EpisodeSet:
    """A set of episodes for reading, as it was when opened."""

    def __init__(self, root: str | os.PathLike[str], complete: bool = True) -> None:
        """Open a set.

        Args:
            root: Folder of the set, or of the run that recorded it into its `episodes/`.
            complete: Whether every file must be there; else `read` finds what is missing.

        Raises:
            UserError: Not a set, an unknown version, or written by lerobot in part or whole; a
                metadata file is corrupt; a file is missing.
        """
        self.root = set_files.set_folder(Path(root))
        info = set_files.load_info(self.root)
        self.fps: int = info["fps"]
        self.features: dict[str, dict[str, Any]] = {
            key: feature for key, feature in info["features"].items() if key not in INDEX_DTYPES
        }
        table = set_files.load_table(self.root, set_files.EPISODES, leave_out="stats/")
        set_files.refuse_other_writers(self.root, info["features"], table)
        self._rows: list[Row] = table.slice(0, info["total_episodes"]).to_pylist()
        if len(self._rows) < info["total_episodes"]:
            raise UserError(
                f"{self.root / set_files.EPISODES} lists {len(self._rows)} of "
                f"{info['total_episodes']} episodes: {set_files.repair_command(self.root)}"
            )
        for row in self._rows if complete else ():  # before any work with the others
            for name in self._files(row):
                if not (self.root / name).is_file():
                    raise set_files.unreadable(self.root, name, FileNotFoundError())

    def __len__(self) -> int:
        return len(self._rows)

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the set, independent of its folder.

        It covers every episode's length, task, meta, statistics and checksums of videos.
        """
        table = set_files.load_table(self.root, set_files.EPISODES).slice(0, len(self))
        return hashlib.sha256(json.dumps(table.to_pylist(), sort_keys=True).encode()).hexdigest()

    @property
    def lengths(self) -> list[int]:
        """Number of frames of every episode."""
        return [row["length"] for row in self._rows]

    def episode_checksum(self, i: int) -> str:
        """Return the SHA-256 of episode i's length, meta and checksums of videos.

        It does not change when the set moves or grows.
        """
        content = {
            key: value
            for key, value in self._row(i).items()
            if key == "length" or key.startswith(set_files.META_PREFIX) or key.endswith("/crc32")
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def frame_checksums(self, i: int, key: str) -> frozenset[int]:
        """Return checksums of the frames of a feature of episode i, comparable in this process."""
        if not is_image(key):
            return frozenset(hash(values.tobytes()) for values in self.read(i, [key]).frames[key])
        name = set_files.data_path(set_files.file_number_of(self._row(i)))
        try:
            with pq.ParquetFile(self.root / name, page_checksum_verification=True) as file:
                images = file.read([f"{key}.bytes"])[key].combine_chunks().field("bytes")
                return frozenset(hash(image.as_py()) for image in images)
        except (OSError, pa.ArrowException) as error:
            raise set_files.unreadable(self.root, name, error) from error

    def meta(self, i: int) -> dict[str, MetaValue]:
        """Return the facts about episode i."""
        prefix = set_files.META_PREFIX
        row = self._row(i)
        return {k.removeprefix(prefix): v for k, v in row.items() if k.startswith(prefix)}

    def task(self, i: int) -> str:
        """Return the instruction of episode i."""
        return self._row(i)["tasks"][0]

    def read(
        self, i: int, keys: Sequence[str] | None = None, frames: Sequence[int] | None = None
    ) -> Episode:
        """Read episode i; only the keys and frames asked for are decoded.

        Args:
            keys: Keys to read; None for all.
            frames: Indices of the frames to read, in any order; None for all.

        Raises:
            UserError: No such episode, key or frame; a file is missing or corrupt.
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

    def __repr__(self) -> str:
        return f"EpisodeSet({str(self.root)!r}: {len(self)} episodes, {', '.join(self.features)})"

    def _files(self, row: Row) -> list[str]:
        number = set_files.file_number_of(row)
        videos = [set_files.video_path(key, number) for key in self.features if is_camera(key)]
        return [set_files.data_path(number), *videos]

    def _row(self, i: int) -> Row:
        if not 0 <= i < len(self):
            raise UserError(f"{self.root} has episodes 0 to {len(self) - 1}, not {i}")
        return self._rows[i]

    def _read_data(
        self, row: Row, features: dict[str, dict[str, Any]], frames: np.ndarray
    ) -> dict[str, np.ndarray]:
        name = set_files.data_path(set_files.file_number_of(row))
        try:
            with pq.ParquetFile(self.root / name, page_checksum_verification=True) as file:
                if file.metadata.num_rows != row["length"]:
                    raise OSError(f"{file.metadata.num_rows} frames instead of {row['length']}")
                return read_columns(file, features, frames)
        except (OSError, pa.ArrowException) as error:
            raise set_files.unreadable(self.root, name, error) from error

    def _read_video(self, row: Row, key: str, frames: np.ndarray) -> UInt8[np.ndarray, "n h w 3"]:
        name = set_files.video_path(key, set_files.file_number_of(row))
        video = set_files.read_video(self.root, name, row[f"videos/{key}/crc32"])
        return decode_video(video, self.fps, frames.tolist())

"""Sets of episodes on disk: LeRobotDataset v3, written and read without lerobot.

Sets that lerobot wrote, edited or continued are read, too; touchgoal changes only its own.

In these every episode has its own data file and its own videos, numbered by the same number; an append
writes them first and then everything under meta/, each file in one atomic step, info.json last.
A set holds what its info.json lists; a process killed at any moment leaves at most the files of the
episode in progress, which `repair` adds (if complete) or moves aside.
"""

import hashlib
import json
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import av.error
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped, UInt8

from touchgoal.episodes.format import episode_table, remote, set_files
from touchgoal.episodes.format.encoding import EncodedEpisode, encode, read_columns, write_data_file
from touchgoal.episodes.format.episode_table import EpisodePlace, EpisodePlaces
from touchgoal.episodes.format.foreign import foreign_file, refusal
from touchgoal.episodes.format.metadata import SetMetadata
from touchgoal.episodes.format.repair import unlisted_files
from touchgoal.episodes.format.set_files import Row
from touchgoal.episodes.format.statistics import Stats
from touchgoal.episodes.keys import guess_keys, note_guess, readable_features, stored_names
from touchgoal.episodes.media import decode_video, video_checksum, video_length
from touchgoal.episodes.schema import INDEX_DTYPES, Episode, MetaValue
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.folder_lock import FolderLock


class EpisodeWriter:
    """Writer that appends episodes to a new or an existing set; one at a time.

    The first episode fixes the features, image sizes and meta keys of a new set. A second writer, in
    this process or another one, is refused until this one is closed or garbage, or its process ends.
    `metadata` is the set's; None before the first episode.
    """

    def __init__(self, root: str | os.PathLike[str], fps: int = 20) -> None:
        """Open a set for appending; no file is written before the first `append`.

        Args:
            root: Folder of the set; made if missing.
            fps: Frames per second of the episodes to come.

        Raises:
            UserError: An existing set has another rate, was interrupted, is damaged or was edited by
                lerobot; another process records into it; the folder cannot be made or is remote.
        """
        self._root = Path(root)
        remote.check_local(self._root)
        self._fps = fps
        self._lock = FolderLock(self._root)
        try:
            self.metadata = self._load()
        except BaseException:
            self._lock.release()
            raise

    def _load(self) -> SetMetadata | None:
        """Return the checked metadata of the set; None before the first episode."""
        found, wrong = None, []
        if (self._root / set_files.INFO).exists():
            info = set_files.load_info(self._root)
            table = episode_table.load_table(self._root)
            if path := foreign_file(self._root, info["features"], table):
                raise refusal(self._root, path)
            found = SetMetadata.load(self._root)
            if found.fps != self._fps:
                raise UserError(
                    f"{self._root} runs at {found.fps} frames per second, not {self._fps}: "
                    "continue it at its own rate or record into another folder"
                )
            counted = found.info()
            if any(info[key] != counted[key] for key in info if key.startswith("total_")):
                wrong = [set_files.INFO]
        if doubtful := unlisted_files(self._root, found) + wrong:
            raise UserError(
                f"{self._root} was interrupted (see {doubtful[0]}): "
                f"{set_files.repair_command(self._root)}"
            )
        return found

    def __len__(self) -> int:
        return 0 if self.metadata is None else self.metadata.n_episodes

    def close(self) -> None:
        """Release the set for another writer."""
        self._lock.release()

    def append(self, episode: Episode | EncodedEpisode) -> int:
        """Add an episode and return its index in the set; it is on disk by then.

        Raises:
            UserError: The episode is unsound or does not fit the set, which stays as it was; or
                another process writes to the set.
        """
        whole = isinstance(episode, Episode)
        encoded = encode(episode, self._fps, self._root) if whole else episode
        description = encoded.description
        current = self.metadata or SetMetadata(self._fps, description.features)
        file_number = current.next_file_number
        updated = current.with_episode(description, file_number)
        if (path := self._root / set_files.data_path(file_number)).exists():
            raise UserError(
                f"{path} appeared while recording: let only one process write to a set, then "
                f"{set_files.repair_command(self._root)}"
            )
        for key, video in encoded.videos.items():
            write_file(self._root / set_files.video_path(key, file_number), video)
        write_data_file(path, encoded, current.index_columns_for(description))
        updated.write(self._root, current.files)
        self.metadata = updated
        return len(self) - 1


class EpisodeSet:
    """A set of episodes for reading, as it was when opened: touchgoal's own, or any LeRobot v3 set."""

    def __init__(
        self,
        root: str | os.PathLike[str],
        complete: bool = True,
        keys: Mapping[str, str] | None = None,
    ) -> None:
        """Open a set.

        Args:
            root: Folder of the set, or of the run that recorded it into its `episodes/`; or its address,
                such as s3://bucket/set (see `remote`). Attribute `root` is then the mirror.
            complete: Whether every file must be there; else `read` finds what is missing.
            keys: New keys of features by their stored names. A set that has the new key and not the
                stored name is left as it is, so that one map serves sets of both kinds. In a set that
                touchgoal did not write, tactile images under other names are recognised without
                (noted on stderr).

        Raises:
            UserError: Not a set, or of an unknown version; a metadata file is corrupt; a file is
                missing; a key that cannot be.
        """
        self.root = set_files.set_folder(remote.local_folder(Path(root)))
        info = set_files.load_info(self.root)
        self.sets: tuple[EpisodeSet, ...] = (self,)
        """Sets on disk that hold the episodes, in order."""
        self.fps: int = info["fps"]
        table = episode_table.load_table(self.root)
        self.foreign = foreign_file(self.root, info["features"], table) is not None
        """Whether lerobot wrote, edited or continued the set; touchgoal does not change such a one."""
        features = readable_features(info["features"])
        self.keys = dict(keys or {})
        """New keys of features by their stored names, as given."""
        given = {k: v for k, v in self.keys.items() if k in features or v not in features}
        guessed = guess_keys(features) if self.foreign else {}
        if guessed := {k: v for k, v in guessed.items() if k not in given}:
            note_guess(self.root, tuple(guessed.items()))
        self._stored = stored_names(self.root, features, guessed | given)
        self.features: dict[str, dict[str, Any]] = {
            key: features[stored] for key, stored in self._stored.items()
        }
        self._places = EpisodePlaces(self.root, info, table)
        self.lengths = self._places.lengths
        """Number of frames of every episode."""
        if complete and (name := remote.first_missing(self.root, self._places.files())):
            raise self._unreadable(name, FileNotFoundError())

    def __len__(self) -> int:
        return len(self.lengths)

    def part(self, i: int) -> "tuple[EpisodeSet, int]":
        """Return the set on disk that holds episode i, and its index there."""
        return self, self._checked(i)

    @cached_property
    def stats(self) -> dict[str, Stats]:
        """Recorded statistics over all frames of each feature, as in meta/stats.json."""
        recorded = set_files.load_json(self.root, set_files.STATS)
        return {key: recorded[name] for key, name in self._stored.items() if name in recorded}

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the set, independent of its folder.

        It covers every episode's length, task, meta, statistics and checksums of videos; of a foreign
        set all frames.
        """
        rows: Iterator[Any] = map(self.episode_checksum, range(len(self)))
        if not self.foreign:
            names = set_files.episodes_files(self.root)
            files = (set_files.read_parquet(self.root, name) for name in names)
            rows = islice(episode_table.rows_of(files), len(self))
        digest = hashlib.sha256(b"[")
        for i, row in enumerate(rows):
            digest.update((", " * (i > 0) + json.dumps(row, sort_keys=True)).encode())
        digest.update(b"]")
        return digest.hexdigest()

    def episode_checksum(self, i: int) -> str:
        """Return the SHA-256 of the content of episode i.

        It does not change when the set moves or grows. Of touchgoal's own episodes it covers length,
        task, meta, statistics of every feature and checksums of videos; of others all stored frames.
        """
        place = self._place(i)
        if self.foreign:
            content: dict[str, Any] = self._content_checksums(place)
        else:
            indices = tuple(f"stats/{key}/" for key in INDEX_DTYPES)
            content = {
                key: value
                for key, value in self._listed_row(i).items()
                if key in ("length", "tasks")
                or key.endswith("/crc32")
                or (key.startswith("stats/") and not key.startswith(indices))
                or (key.startswith(set_files.META_PREFIX) and value is not None)
            }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def _listed_row(self, i: int) -> Row:
        """Return the row of meta/episodes of an episode of an own set, with statistics."""
        number = self._places.facts(i, "meta/episodes/")
        chunk, file = (number[f"meta/episodes/{name}_index"] for name in ("chunk", "file"))
        name = set_files.episodes_path(chunk * set_files.CHUNK + file)
        table = _read_listed(self.root, name, (self.root / name).stat().st_mtime_ns)
        return table.slice(table["episode_index"].index(i).as_py(), 1).to_pylist()[0]

    def frame_checksums(self, i: int, key: str) -> frozenset[int]:
        """Return checksums of the frames of a feature of episode i, comparable in this process."""
        if self.features[key]["dtype"] != "image":
            return frozenset(hash(values.tobytes()) for values in self.read(i, [key]).frames[key])
        images = self._stored_column(self._place(i), self._stored[key], keep=False).field("bytes")
        return frozenset(hash(image.as_py()) for image in images)

    def meta(self, i: int) -> dict[str, MetaValue]:
        """Return the facts about episode i; lerobot records none."""
        prefix = set_files.META_PREFIX
        facts = self._places.facts(self._checked(i), prefix)
        return {k.removeprefix(prefix): v for k, v in facts.items() if v is not None}

    def task(self, i: int) -> str:
        """Return the instruction of episode i; "" if none is recorded."""
        return (self._places.facts(self._checked(i), "tasks")["tasks"] or [""])[0]

    def stored_numbers(self, i: int, key: str) -> Shaped[np.ndarray, "n d"]:
        """Return a feature of episode i, or `timestamp` (s from its start), as stored.

        A column is read once for all episodes of a file.
        """
        column = self._stored_column(self._place(i), self._stored.get(key, key))
        while not pa.types.is_primitive(column.type):
            column = column.flatten()
        return column.to_numpy(zero_copy_only=False).reshape(self.lengths[i], -1)

    def video_length(self, i: int, key: str) -> tuple[int, int, float]:
        """Return the frames that camera `key` has for episode i by its time stamps and by its file.

        Third is the rate of the video, frames per second. UserError: the video is unreadable.
        """
        place = self._place(i).videos[self._stored[key]]
        with self._readable(place.file) as path:
            length, fps = video_length(path)
        return place.n_frames, length - place.first_frame, fps

    def read(
        self, i: int, keys: Sequence[str] | None = None, frames: Sequence[int] | None = None
    ) -> Episode:
        """Read episode i; only the keys and frames asked for, in any order, are decoded.

        UserError: no such episode, key or frame; a file is missing or corrupt.
        """
        place = self._place(i)
        keys = list(self.features) if keys is None else keys
        if unknown := [key for key in keys if key not in self.features]:
            raise UserError(f"{self.root} has no {unknown[0]}; it has {', '.join(self.features)}")
        wanted = np.arange(place.length) if frames is None else np.asarray(frames, np.int64)
        outside = wanted[(wanted < 0) | (wanted >= place.length)]
        if len(outside):
            raise UserError(
                f"episode {i} of {self.root} has frames 0 to {place.length - 1}, not {outside[0]}"
            )
        videos = [key for key in keys if self.features[key]["dtype"] == "video"]
        columns = {self._stored[key]: self.features[key] for key in keys if key not in videos}
        stored = self._read_data(i, columns, wanted) if columns else {}
        read = {key: stored[self._stored[key]] for key in keys if key not in videos}
        read |= {key: self._read_video(place, self._stored[key], wanted) for key in videos}
        return Episode({key: read[key] for key in keys}, self.task(i), self.meta(i))

    def __repr__(self) -> str:
        return f"EpisodeSet({str(self.root)!r}: {len(self)} episodes, {', '.join(self.features)})"

    def _place(self, i: int) -> EpisodePlace:
        return self._places[self._checked(i)]

    def _checked(self, i: int) -> int:
        if not 0 <= i < len(self):
            raise UserError(f"{self.root} has episodes 0 to {len(self) - 1}, not {i}")
        return i

    def _unreadable(self, name: str, error: Exception) -> UserError:
        """Return the error that a file is missing or broken; only own sets can be repaired."""
        if not self.foreign:
            return set_files.unreadable(self.root, name, error)
        missing = isinstance(error, FileNotFoundError)
        reason = "missing" if missing else f"corrupt ({str(error).splitlines()[0]})"
        return UserError(f"{self.root / name} is {reason}: copy the set again")

    @contextmanager
    def _readable(self, name: str) -> Iterator[Path]:
        """Yield a file of the set, fetched if it is remote; name it in whatever goes wrong."""
        try:
            yield remote.fetched(self.root, name)
        except UserError as error:
            raise UserError(f"{self.root / name}: {error}") from error
        except (OSError, pa.ArrowException, av.error.FFmpegError, ValueError) as error:
            raise self._unreadable(name, error) from error

    def _read_data(
        self, i: int, features: dict[str, dict[str, Any]], frames: np.ndarray
    ) -> dict[str, np.ndarray]:
        place = self._place(i)
        with (
            self._readable(place.data_file) as path,
            pq.ParquetFile(path, page_checksum_verification=True) as file,
        ):
            rows = file.metadata.num_rows
            if place.alone and rows != place.length:
                raise OSError(f"{rows} frames instead of {place.length}")
            if rows < place.first_row + place.length:
                raise OSError(f"{rows} frames, too few for episode {i}")
            return read_columns(file, features, frames + place.first_row)

    def _stored_column(self, place: EpisodePlace, name: str, keep: bool = True) -> pa.Array:
        """Return a column of one episode; small ones are kept for the file's other episodes."""
        read = _read_column if keep else _read_column.__wrapped__
        with self._readable(place.data_file) as path:
            column = read(path, path.stat().st_mtime_ns, name)
            return pa.concat_arrays(column.slice(place.first_row, place.length).chunks)

    def _content_checksums(self, place: EpisodePlace) -> dict[str, Any]:
        """Return checksums of everything that is stored of an episode but its place in the set."""
        found: dict[str, Any] = {"tasks": place.facts["tasks"]}
        for key, feature in self.features.items():
            stored = self._stored[key]
            if feature["dtype"] == "video":
                video = place.videos[stored]
                with self._readable(video.file) as path:
                    found[stored] = video_checksum(path, self.fps, video.first_frame, place.length)
            elif feature["dtype"] == "image":
                images = self._stored_column(place, stored, keep=False).field("bytes")
                found[stored] = [zlib.crc32(image.as_py()) for image in images]
            else:
                values = self._stored_column(place, stored).to_pylist()
                found[stored] = zlib.crc32(repr(values).encode())
        return found

    def _read_video(
        self, place: EpisodePlace, stored: str, frames: np.ndarray
    ) -> UInt8[np.ndarray, "n h w 3"]:
        video = place.videos[stored]
        source: bytes | Path = remote.fetched(self.root, video.file)
        if not self.foreign and video.crc32 is not None:
            source = set_files.read_video(self.root, video.file, video.crc32)
        with self._readable(video.file):
            return decode_video(source, self.fps, (frames + video.first_frame).tolist())


@lru_cache(maxsize=8)  # columns of a file whose episodes are gone through one by one
def _read_column(path: Path, modified: int, name: str) -> pa.ChunkedArray:
    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        return file.read([name])[name]


@lru_cache(maxsize=8)
def _read_listed(root: Path, name: str, modified: int) -> pa.Table:
    return set_files.read_parquet(root, name)

"""Check of a set of episodes, and repair after a crash or damage."""

import os
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.encoding import Description, read_description, write_tables
from touchgoal.episodes.format.episode_table import rows_of
from touchgoal.episodes.format.foreign import foreign_data_file, foreign_file, refusal
from touchgoal.episodes.format.metadata import SetMetadata
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.folder_lock import FolderLock
from touchgoal.runtime.progress import track

REPAIRED = "repaired"
_FOLDERS = ("data", "videos", "meta")
_META = (set_files.INFO, set_files.EPISODES, set_files.TASKS, set_files.STATS)

_DATA_FILES = "chunk-[0-9][0-9][0-9]/file-[0-9][0-9][0-9].parquet"


def unlisted_files(root: Path, set_metadata: SetMetadata | None) -> list[str]:
    """Return the files that belong to no listed episode, as paths in the set, without hidden ones."""
    known = set(_META)
    if set_metadata:
        known |= {set_files.episodes_path(number) for number in range(len(set_metadata.files))}
    features = set_metadata.features if set_metadata else {}
    cameras = [key for key, feature in features.items() if feature["dtype"] == "video"]
    for file_number in _file_numbers(set_metadata):
        known |= {set_files.data_path(file_number)} | {
            set_files.video_path(k, file_number) for k in cameras
        }
    files = [path for tree in _FOLDERS for path in (root / tree).rglob("*") if path.is_file()]
    names = {path.relative_to(root) for path in files}
    shown = {name.as_posix() for name in names if not any(p.startswith(".") for p in name.parts)}
    return sorted(shown - known)


def _file_numbers(set_metadata: SetMetadata | None) -> list[int]:
    names = ["data/chunk_index", "data/file_index"]
    tables = set_metadata.files if set_metadata else ()
    return [set_files.file_number_of(row) for t in tables for row in t.select(names).to_pylist()]


def _read_episode(root: Path, file_number: int) -> tuple[Description, pa.Table]:
    """Read every byte of an episode's files and compare the checksums."""
    name = set_files.data_path(file_number)
    try:
        with pq.ParquetFile(root / name, page_checksum_verification=True) as file:
            description, table = read_description(file), file.read()
    except (OSError, pa.ArrowException, UserError) as error:
        raise set_files.unreadable(root, name, error) from error
    for key, crc32 in description.video_crc32.items():
        set_files.read_video(root, set_files.video_path(key, file_number), crc32)
    return description, table


def _wrong_index_columns(table: pa.Table, indices: dict[str, np.ndarray]) -> list[str]:
    return [k for k, values in indices.items() if not np.array_equal(table[k].to_numpy(), values)]


def _require_own_set(root: Path) -> None:
    """Raise UserError unless touchgoal wrote the set: a repair moves unknown files aside."""
    listed = [path for path in root.iterdir() if path.name != REPAIRED] if root.is_dir() else [root]
    if listed and not any((root / folder).is_dir() for folder in _FOLDERS):
        raise UserError(f"{root} is not a set of episodes: give the folder of one")
    if (root / set_files.INFO).exists():
        info: dict[str, Any] = {"codebase_version": set_files.VERSION}
        with suppress(UserError):  # damaged: it is rebuilt from the data files
            info = set_files.load_json(root, set_files.INFO)
        set_files.check_version(root, info)
    if path := foreign_file(root, {}, None) or foreign_data_file(root):
        raise refusal(root, path)


def validate(root: str | os.PathLike[str]) -> list[str]:
    """Read every file of a set and return what is wrong, one line a problem; [] if it is sound.

    UserError: not a set, one of another version, or one that lerobot wrote or continued.
    """
    root = set_files.set_folder(Path(root))
    _require_own_set(root)
    if not any((root / folder).is_dir() for folder in _FOLDERS):
        return []  # nothing was recorded yet
    try:
        set_metadata = SetMetadata.load(root)
    except UserError as error:
        return [str(error)]
    problems: list[str] = []
    rebuilt: SetMetadata | None = None
    for file_number in track(_file_numbers(set_metadata), "checking", "file"):
        try:
            description, table = _read_episode(root, file_number)
            rebuilt = rebuilt or SetMetadata(description.fps, description.features)
            if differing := _wrong_index_columns(table, rebuilt.index_columns_for(description)):
                name = root / set_files.data_path(file_number)
                problems.append(
                    f"{name} has wrong {', '.join(differing)}: {set_files.repair_command(root)}"
                )
            rebuilt = rebuilt.with_episode(description, file_number)
        except UserError as error:
            problems.append(str(error))
    if not problems and rebuilt is not None:
        problems += _altered_meta(root, set_metadata, rebuilt)
    return problems + [
        f"{root / n} belongs to no episode" for n in unlisted_files(root, set_metadata)
    ]


def _altered_meta(root: Path, found: SetMetadata, rebuilt: SetMetadata) -> list[str]:
    """Return the files under meta/ whose content is not that of the data files."""
    same = {
        set_files.INFO: set_files.load_info(root) == rebuilt.info(),
        set_files.EPISODES: all(a == b for a, b in zip(_rows(found), _rows(rebuilt), strict=True)),
        set_files.TASKS: found.tasks == rebuilt.tasks,
        set_files.STATS: found.stats == rebuilt.stats,
    }
    return [
        f"{root / name} is not as it was written: {set_files.repair_command(root)}"
        for name, equal in same.items()
        if not equal
    ]


def _rows(set_metadata: SetMetadata) -> Iterator[set_files.Row]:
    """Yield the rows of meta/episodes but for the file of each."""
    for row in rows_of(set_metadata.files):
        yield {key: v for key, v in row.items() if not key.startswith("meta/episodes/")}


def repair(root: str | os.PathLike[str]) -> list[str]:
    """Make a set sound again after a crash or damage; nothing is deleted.

    Every episode whose files are whole stays, in order; other files move to `repaired/` inside the
    set, and so does the old meta/, which is rebuilt from the data files. A killed repair can be run
    again. Returns what was done, one line each; [] if the set was sound. UserError: not a set, one
    of another version, or one that lerobot wrote or continued.
    """
    root = set_files.set_folder(Path(root))
    if not validate(root):
        return []
    lock = FolderLock(root)
    try:
        return _repair(root)
    finally:
        lock.release()


def _repair(root: Path) -> list[str]:
    done: list[str] = []
    set_metadata: SetMetadata | None = None
    for path in track(sorted((root / "data").glob(_DATA_FILES)), "reading", "file"):
        file_number = int(path.parent.name[-3:]) * set_files.CHUNK + int(path.stem[-3:])
        try:
            description, table = _read_episode(root, file_number)
            before = set_metadata or SetMetadata(description.fps, description.features)
            set_metadata = before.with_episode(description, file_number)
        except UserError as error:
            reason = str(error).removesuffix(": " + set_files.repair_command(root))
            done.append(f"left out the episode of {path}: {reason}")
            continue
        if _wrong_index_columns(table, before.index_columns_for(description)):
            _rewrite_index_columns(path, description, table, before.index_columns_for(description))
            done.append(f"renumbered {path}")
    done += [_move_to_repaired(root, name) for name in unlisted_files(root, set_metadata)]
    meta = {*_META, *set_files.episodes_files(root)}
    done += [_move_to_repaired(root, name) for name in sorted(meta) if (root / name).exists()]
    if set_metadata is None:
        return [*done, f"no whole episode is left in {root}"]
    set_metadata.write(root)
    return [*done, f"wrote {root / 'meta'} again for {set_metadata.n_episodes} episodes"]


def _rewrite_index_columns(
    path: Path, description: Description, table: pa.Table, indices: dict[str, np.ndarray]
) -> None:
    for key, values in indices.items():
        table = table.set_column(table.column_names.index(key), key, pa.array(values))
    with atomic_write(path) as unfinished:
        write_tables(unfinished, [table], description)


def _move_to_repaired(root: Path, name: str) -> str:
    """Move a file of the set into `repaired/`, beside what an earlier repair moved there."""
    names = chain([name], (f"{name}.{i}" for i in count(1)))
    target = next(path for free in names if not (path := root / REPAIRED / free).exists())
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(root / name, target)
    return f"moved {root / name} to {target}"

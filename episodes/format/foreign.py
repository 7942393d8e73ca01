"""Detection of sets that lerobot wrote, edited or continued.

touchgoal writes one data file per episode with a description in its footer, and marks the footers under
meta/episodes; lerobot puts several episodes into a file, begins further files and drops the footers.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from touchgoal.control.features import FEATURES
from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.encoding import has_mark
from touchgoal.episodes.format.remote import fetched
from touchgoal.episodes.schema import INDEX_DTYPES
from touchgoal.runtime.errors import UserError


def foreign_file(root: Path, features: dict[str, Any], episodes: pa.Table | None) -> Path | None:
    """Return a file that touchgoal did not write as it stands; None for a set of touchgoal's own.

    `episodes` is None if meta/episodes cannot be read. UserError: the set is touchgoal's own, and a
    file under meta/ is corrupt.
    """
    marked = episodes is not None and has_mark(episodes.schema)
    listed = [] if marked else sorted((root / "meta/episodes").rglob("*.parquet"))
    others = (path for path in listed if path != root / set_files.EPISODES)
    if other := next((path for path in others if _written_by_touchgoal(path) is False), None):
        return other
    if unknown := sorted(set(features) - {*FEATURES, *INDEX_DTYPES}):
        return _foreign_unless_own(root, set_files.INFO, f"unknown feature {unknown[0]!r}")
    if episodes is None or not episodes.num_rows:
        return None
    cameras = [key for key, feature in features.items() if feature["dtype"] == "video"]
    unchecked = any(f"videos/{key}/crc32" not in episodes.column_names for key in cameras)
    numbers = ["data/chunk_index", "data/file_index"]
    distinct = episodes.select(numbers).group_by(numbers).aggregate([]).num_rows
    if unchecked or distinct < episodes.num_rows:
        return _foreign_unless_own(root, set_files.EPISODES, "wrong places of files")
    last = fetched(root, set_files.data_path_of(set_files.last_row(episodes)))
    return last if _written_by_touchgoal(last) is False else None


def _foreign_unless_own(root: Path, name: str, reason: str) -> Path:
    """Return a foreign data file; raise that `name` is corrupt if touchgoal wrote them all."""
    if path := foreign_data_file(root, if_none=root / name):
        return path
    raise set_files.unreadable(root, name, ValueError(reason))


def foreign_data_file(root: Path, if_none: Path | None = None) -> Path | None:
    """Return the first readable data file that touchgoal did not write; None if it wrote them all.

    Where none can be read, `if_none` is returned.
    """
    own = False
    for path in sorted((root / "data").rglob("*.parquet")):
        written = _written_by_touchgoal(path)
        if written is False:
            return path
        own |= written is True
    return None if own else if_none


def _written_by_touchgoal(path: Path) -> bool | None:
    """Return whether a Parquet file has touchgoal's footer; None if it cannot be read."""
    with suppress(OSError, pa.ArrowException), pq.ParquetFile(path) as file:
        return has_mark(file.schema_arrow)
    return None


class ForeignSetError(UserError):
    """A set that touchgoal reads but does not change."""


def refusal(root: Path, path: Path) -> ForeignSetError:
    """Return the error that touchgoal does not change a set because of this file."""
    return ForeignSetError(
        f"{root} holds episodes that lerobot wrote (see {path}); touchgoal reads them and changes "
        "nothing here: record into another folder, or edit the set with lerobot"
    )

"""Conversion of an episode to the bytes on disk, and back.

Numbers are stored as they are, touch as PNG, cameras as H.264, both lossless. Encoding is the
slow part of recording and holds no state: worker processes encode, one process appends.

The Parquet footer of a data file carries a `Description` of its episode as JSON (key `touchgoal`) and
its checksum, so that everything under meta/ can be rebuilt from the data files alone.
"""

import json
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Int, Shaped, UInt8

from touchgoal.control.features import FEATURES
from touchgoal.episodes.format import statistics
from touchgoal.episodes.media import encode_video
from touchgoal.episodes.schema import Episode, MetaValue, describe_features, is_camera, is_image
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import decode_image

# Reading one window of touch reads a few groups, not the whole episode; the writer holds 35 kB of
# metadata a group.
_ROWS_PER_GROUP, _MAX_ROW_GROUPS = 32, 500
_FOOTER_KEY, _CHECKSUM_KEY = b"touchgoal", b"touchgoal.crc32"
# Measured on noisy 320 x 240 touch: 3.6 ms and 90 kB a frame; OpenCV's default filter 8.1 ms and
# 110 kB, PIL at compress_level 1 11.0 ms and 114 kB.
_PNG = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
]


@dataclass(frozen=True)
class Description:
    """Everything about an episode but its frames and its place in a set."""

    fps: int  # frames per second
    features: dict[str, dict[str, Any]]  # as in LeRobot's meta/info.json
    task: str  # instruction
    meta: dict[str, MetaValue]  # facts about the episode
    length: int  # number of frames
    stats: dict[str, statistics.Stats]  # key -> statistics, without the index columns
    video_crc32: dict[str, int]  # camera key -> checksum of its MP4 file

    @property
    def rows_per_group(self) -> int:
        """Frames in a row group of the data file."""
        return max(_ROWS_PER_GROUP, -(-self.length // _MAX_ROW_GROUPS))


@dataclass(frozen=True, eq=False)
class EncodedEpisode:
    """An episode ready to be appended; it pickles, unless it was encoded with a folder."""

    description: Description  # everything but the frames
    # key -> PNG bytes per frame for touch, or the images themselves; array (T, d) for numbers
    columns: dict[str, Shaped[np.ndarray, "n ..."] | list[bytes]]
    videos: dict[str, bytes | mmap]  # camera key -> MP4 bytes


def encode(episode: Episode, fps: int, folder: Path | None = None) -> EncodedEpisode:
    """Compress an episode recorded at `fps` frames per second.

    With a `folder` for its videos, and frames mapped from files, an episode of any length takes the
    same memory. UserError: the episode does not pass `Episode.check`.
    """
    episode.check()
    columns, videos, stats = {}, {}, {}
    for key in (key for key in FEATURES if key in episode.frames):
        values = episode.frames[key]
        if is_camera(key):
            videos[key] = encode_video(values, fps, folder)
        else:
            encodes = is_image(key) and not folder
            columns[key] = [encode_png(image) for image in values] if encodes else values
        compute = statistics.image_statistics if is_image(key) else statistics.array_statistics
        stats[key] = compute(values)
    description = Description(
        fps=fps,
        features=describe_features(episode, fps),
        task=episode.task,
        meta=dict(episode.meta),
        length=len(episode),
        stats=stats,
        video_crc32={key: zlib.crc32(video) for key, video in videos.items()},
    )
    return EncodedEpisode(description, columns, videos)


def encode_png(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Return an RGB image as a PNG file, tuned for speed."""
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _PNG)[1].tobytes()


def decode_png(png: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Return the RGB image of a PNG file."""
    image = decode_image(png, "an image in the data file")
    if image is None:
        raise UserError("an image in the data file is no readable PNG")
    return image


def write_data_file(
    path: Path, encoded: EncodedEpisode, indices: dict[str, Shaped[np.ndarray, " n"]]
) -> None:
    """Write the Parquet file of an episode's numbers and touch, with its description in the footer."""

    def tables() -> Iterator[pa.Table]:
        size = encoded.description.rows_per_group
        for begin in range(0, encoded.description.length, size):
            rows = slice(begin, begin + size)
            arrays = {
                key: _to_arrow(key, c[rows], begin, path.parent)
                for key, c in encoded.columns.items()
            }
            yield pa.table(arrays | {key: pa.array(c[rows]) for key, c in indices.items()})

    with atomic_write(path) as unfinished:
        write_tables(unfinished, tables(), encoded.description)


def write_tables(path: Path, tables: Iterable[pa.Table], description: Description) -> None:
    """Write tables of an episode's frames as one Parquet file, with a checksum on every page.

    Each but the last has a whole number of row groups; the description goes into the footer.
    """
    text = json.dumps(vars(description)).encode()
    footer = {_FOOTER_KEY: text, _CHECKSUM_KEY: str(zlib.crc32(text)).encode()}
    marked = (table.replace_schema_metadata(footer) for table in tables)
    first = next(marked)
    with pq.ParquetWriter(
        path,
        first.schema,
        compression="none",  # PNG is compressed; numbers are a thousandth of the bytes
        use_dictionary=False,
        write_statistics=False,  # they would repeat whole images as a column's min and max
        write_page_checksum=True,
        write_batch_size=8,  # rows between two looks at the size of a page, which lies in memory
    ) as file:
        for table in chain([first], marked):
            file.write_table(table, description.rows_per_group)


def has_mark(schema: pa.Schema) -> bool:
    """Return whether touchgoal wrote the Parquet file of this schema."""
    return _FOOTER_KEY in (schema.metadata or {})


def read_description(file: pq.ParquetFile) -> Description:
    """Return the description in a data file's footer.

    UserError: touchgoal did not write the file, or its footer is damaged.
    """
    if not has_mark(file.schema_arrow):
        raise UserError("this Parquet file was not written by touchgoal")
    text, footer = file.schema_arrow.metadata[_FOOTER_KEY], file.schema_arrow.metadata
    try:
        if int(footer[_CHECKSUM_KEY]) != zlib.crc32(text):
            raise ValueError("checksum")
        description = Description(**json.loads(text))
        stored = {k for k, f in description.features.items() if f["dtype"] != "video"}
        if stored != set(file.schema_arrow.names):
            raise ValueError("columns")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise UserError("the description in this Parquet file is damaged") from error
    return description


def _to_arrow(
    key: str, column: Shaped[np.ndarray, "n ..."] | list[bytes], first: int, folder: Path
) -> pa.Array:
    """Return a column; PNGs lie in a nameless file in `folder`, not in memory."""
    if not is_image(key):
        values = np.ascontiguousarray(column)
        flat = pa.array(values.reshape(-1))
        one = FEATURES[key].shape == (1,)
        return flat if one else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    with tempfile.TemporaryFile(dir=folder) as file:
        sizes = [file.write(x if isinstance(x, bytes) else encode_png(x)) for x in column]
        file.flush()
        data = pa.py_buffer(mmap(file.fileno(), 0, access=ACCESS_READ))
    ends = pa.py_buffer(np.cumsum([0, *sizes], dtype=np.int32))
    pngs = pa.BinaryArray.from_buffers(pa.binary(), len(sizes), [None, ends, data])
    names = pa.array(f"frame-{first + i:06d}.png" for i in range(len(sizes)))
    return pa.StructArray.from_arrays([pngs, names], names=["bytes", "path"])


def read_columns(
    file: pq.ParquetFile, features: dict[str, dict[str, Any]], frames: Int[np.ndarray, " n"]
) -> dict[str, Shaped[np.ndarray, "n ..."]]:
    """Read some columns of some rows of a data file, in any order; nothing else is decoded.

    `features` are as in info.json; `frames` are rows of the file. ValueError: a column does not hold
    what its feature says.
    """
    out = {
        key: np.empty(
            (len(frames), *feature["shape"]),
            np.uint8 if feature["dtype"] == "image" else feature["dtype"],
        )
        for key, feature in features.items()
    }
    sizes = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
    ends = np.cumsum(sizes)
    group_of = np.searchsorted(ends, frames, side="right")
    for group in np.unique(group_of):
        table = file.read_row_group(int(group), columns=list(features))
        where = np.flatnonzero(group_of == group)
        rows = frames[where] - (ends[group] - sizes[group])
        for key, feature in features.items():
            out[key][where] = _from_arrow(feature, table[key].combine_chunks(), rows)
    return out


def _from_arrow(
    feature: dict[str, Any], column: pa.Array, rows: Int[np.ndarray, " n"]
) -> Shaped[np.ndarray, "n ..."]:
    if feature["dtype"] == "image":
        png = column.field("bytes")
        return np.stack([decode_png(png[int(row)].as_py()) for row in rows])
    while not pa.types.is_primitive(column.type):
        column = column.flatten()
    return column.to_numpy(zero_copy_only=False).reshape(-1, *feature["shape"])[rows]

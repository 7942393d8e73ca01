"""Touch videos with ranked object properties: PhysiCLeAR (Octopi, RSS 2024, arXiv 2405.02794).

A folder holds `videos/` and `labels.csv` with the columns file, object, name, split (train, val, test or
unlabelled), hardness, roughness and bumpiness (0, 1 or 2 each; empty where not ranked).
"""

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from touchgoal.control.sensors.clip import read_frames
from touchgoal.episodes.touches import touch_background
from touchgoal.runtime.errors import UserError

PROPERTIES = ("hardness", "roughness", "bumpiness")
FIRMEST = 5
"""Number of frames of the largest change that represent a video, as published for PhysiCLeAR."""

_SMALL = 80, 60  # px at which the change is measured
_TABLE = "labels.csv"
_COLUMNS = ("file", "object", "name", "split", *PROPERTIES)


@dataclass(frozen=True)
class LabelledVideo:
    """One press of an object."""

    path: Path  # video file
    object: str  # id of the object
    name: str  # name of the object
    split: str  # train, val, test or unlabelled
    ranks: tuple[int, int, int] | None  # `PROPERTIES`, 0 to 2; None where not ranked
    sensor: ClassVar[str] = "gelsight_mini"

    def frames(self) -> UInt8[np.ndarray, "n h w 3"]:
        """Return the RGB frames; the first few are without contact."""
        return read_frames(self.path)[0]

    @property
    def held_out(self) -> bool:
        """Whether training leaves it out."""
        return self.split not in ("train", "unlabelled")

    def frame_checksums(self) -> frozenset[int]:
        """Return checksums of the images, comparable in this process."""
        return frozenset(hash(image.tobytes()) for image in self.frames())

    def open(self) -> tuple[UInt8[np.ndarray, "n h w 3"], UInt8[np.ndarray, "h w 3"]]:
        """Decode the images, and the untouched sensor: the median of the first five."""
        frames = self.frames()
        return frames, touch_background(frames)


def has_labels(folder: Path) -> bool:
    """Return whether a folder has the table of such videos."""
    return (folder / _TABLE).is_file()


def read_labelled_videos(folder: Path) -> list[LabelledVideo]:
    """List the videos of a folder, in the order of `labels.csv`.

    UserError: no such table, a column or a video is missing, or a rank is not 0, 1 or 2.
    """
    table = folder / _TABLE
    videos = [_video(folder, row) for row in read_table(table, _COLUMNS)]
    check_there((video.path for video in videos), table)
    return videos


def firmest_frames(
    frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
) -> Int[np.ndarray, " k"]:
    """Return the indices of the frames that differ most from the untouched sensor, in time."""
    change = np.abs(_shrunk(frames) - _shrunk(background[None])).mean((1, 2, 3))
    return np.sort(np.argsort(-change, kind="stable")[:FIRMEST])


def _shrunk(frames: UInt8[np.ndarray, "n h w 3"]) -> Float[np.ndarray, "n 60 80 3"]:
    small = [cv2.resize(frame, _SMALL, interpolation=cv2.INTER_AREA) for frame in frames]
    return np.stack(small).astype(np.float32)


def _video(folder: Path, row: dict[str, str]) -> LabelledVideo:
    values = [row[name].strip() for name in PROPERTIES]
    ranks = None
    if all(values):
        if not set(values) <= {"0", "1", "2"}:
            raise UserError(f"{folder / _TABLE}: {row['file']} has a rank that is not 0, 1 or 2")
        ranks = int(values[0]), int(values[1]), int(values[2])
    path = folder / "videos" / row["file"]
    return LabelledVideo(path, row["object"], row["name"], row["split"], ranks)


def read_table(table: Path, columns: Iterable[str]) -> list[dict[str, str]]:
    """Read the rows of a CSV file; UserError if it is missing, empty or lacks a column."""
    if not table.is_file():
        raise UserError(f"no {table.name} in {table.parent}: give the folder as it is published")
    with table.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if missing := [name for name in columns if name not in (reader.fieldnames or ())]:
            raise UserError(f"{table} lacks the column {missing[0]}")
        rows = list(reader)
    if not rows:
        raise UserError(f"{table} has no rows: write or fetch it again")
    return rows


def check_there(paths: Iterable[Path], table: Path) -> None:
    """Raise UserError for the first file that a table names and that is missing."""
    if absent := next((path for path in paths if not path.is_file()), None):
        raise UserError(f"{table} names {absent}, which is not there: fetch the set again")

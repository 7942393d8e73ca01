"""Images of a gel with markers and another tracker's positions: gelsight-material-classifier's layout.

A folder holds `SERIES_NUMBER.png` and `SERIES_NUMBER.json` for each image: five tables over the grid's rows
and columns; the third and fourth are x and y of every marker, px, the last its spot (below 0: not found).
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image

_TABLES = 5


@dataclass(frozen=True, eq=False)
class MarkerImage:
    """One image with the other tracker's result."""

    path: Path  # image file
    positions: Float[np.ndarray, "rows columns 2"]  # (x, y) of the markers, px
    found: Bool[np.ndarray, "rows columns"]  # whether the tracker found each

    @property
    def series(self) -> str:
        """Series of consecutive images: the name up to the last underscore."""
        return self.path.stem.rpartition("_")[0]

    def frame(self) -> UInt8[np.ndarray, "h w 3"]:
        """Read the RGB image; UserError for a broken file."""
        image = read_image(self.path)
        if image is None:
            raise UserError(f"{self.path} is no readable image")
        return image


def has_markers(folder: Path) -> bool:
    """Return whether a folder has such tables."""
    return any(folder.glob("*_*.json"))


def read_marker_images(folder: Path) -> list[MarkerImage]:
    """Read the images of a folder, by name.

    UserError: an image is missing, or a file does not hold the tables.
    """
    return [_read(path) for path in sorted(folder.glob("*_*.json"))]


def _read(table: Path) -> MarkerImage:
    path = table.with_suffix(".png")
    if not path.is_file():
        raise UserError(f"{path} is missing, whose markers {table.name} lists")
    try:
        tables = np.array(json.loads(table.read_text()), float)
    except ValueError:
        tables = np.empty(0)
    if tables.ndim != 3 or len(tables) != _TABLES:
        raise UserError(f"{table} does not hold {_TABLES} tables of the markers' rows and columns")
    return MarkerImage(path, np.stack([tables[2], tables[3]], -1), tables[4] >= 0)

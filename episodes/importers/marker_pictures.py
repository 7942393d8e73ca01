"""Pictures of a gel with dots, and where another tracker saw them: gelsight-material-classifier's layout.

A folder holds of each picture `SERIES_NUMBER.png` and `SERIES_NUMBER.json`: five tables of the grid's rows and
columns, of which the third and fourth are x and y of every dot, px, and the last says which spot it is (below 0: none).
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.picture_file import read_picture

_TABLES = 5


@dataclass(frozen=True, eq=False)
class MarkerPicture:
    """One picture, and another tracker's reading of it.

    Attributes:
        path: of the picture.
        positions: (x, y) of the dots, px.
        seen: whether that tracker found each.
    """

    path: Path
    positions: Float[np.ndarray, "rows columns 2"]
    seen: Bool[np.ndarray, "rows columns"]

    @property
    def series(self) -> str:
        """Pictures of one series follow one another: the name up to the last underscore."""
        return self.path.stem.rpartition("_")[0]

    def frame(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB; UserError for a broken file."""
        picture = read_picture(self.path)
        if picture is None:
            raise UserError(f"{self.path} is no picture")
        return picture


def has_markers(folder: Path) -> bool:
    """Whether a folder has such tables."""
    return any(folder.glob("*_*.json"))


def read_marker_pictures(folder: Path) -> list[MarkerPicture]:
    """The pictures of a folder, by name.

    Raises:
        UserError: a picture is missing, or a file does not hold the tables.
    """
    return [_read(path) for path in sorted(folder.glob("*_*.json"))]


def _read(table: Path) -> MarkerPicture:
    path = table.with_suffix(".png")
    if not path.is_file():
        raise UserError(f"{path} is missing, of which {table.name} tells the dots")
    try:
        tables = np.array(json.loads(table.read_text()), float)
    except ValueError:
        tables = np.empty(0)
    if tables.ndim != 3 or len(tables) != _TABLES:
        raise UserError(f"{table} does not hold {_TABLES} tables of the dots' rows and columns")
    return MarkerPicture(path, np.stack([tables[2], tables[3]], -1), tables[4] >= 0)

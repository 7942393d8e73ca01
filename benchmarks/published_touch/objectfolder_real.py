"""One GelSight touch of each of about 100 household objects: ObjectFolder Real (CVPR 2023).

A folder holds `objects.csv` (index, name, material; material empty where unknown), `touch/NNN.png`
and, of some, `image/NNN.jpg`. There is no image of the untouched gel.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from touchgoal.episodes.importers.labelled_videos import check_there, read_table
from touchgoal.episodes.importers.touch_clip import read_image_file
from touchgoal.runtime.errors import UserError

_COLUMNS = ("index", "name", "material")


@dataclass(frozen=True)
class TouchedObject:
    """One object."""

    name: str
    material: str | None  # in lower case; None where not labelled
    touch: Path
    image: Path | None


def read_objectfolder_real(folder: Path) -> list[TouchedObject]:
    """List the objects; UserError if the table, a column or a touch is missing."""
    table = folder / "objects.csv"
    objects = []
    for row in read_table(table, _COLUMNS):
        if not row["index"].isdigit():
            raise UserError(f"{table}: the index {row['index']!r} is no number")
        number = f"{int(row['index']):03d}"
        image = folder / "picture" / f"{number}.jpg"
        objects.append(
            TouchedObject(
                row["name"],
                row["material"].strip().lower() or None,
                folder / "touch" / f"{number}.png",
                image if image.is_file() else None,
            )
        )
    check_there((item.touch for item in objects), table)
    return objects


def read_touches(
    objects: list[TouchedObject],
) -> tuple[UInt8[np.ndarray, "n h w 3"], UInt8[np.ndarray, "h w 3"]]:
    """Return the touches in RGB, wider than high, and their median: the untouched gel.

    UserError: an image cannot be read, or has another size than the first.
    """
    images = [read_image_file(item.touch, "gelsight_mini") for item in objects]
    if odd := next((i for i, p in enumerate(images) if p.shape != images[0].shape), None):
        raise UserError(f"{objects[odd].touch} has another size than the first: fetch it again")
    touches = np.stack(images)
    return touches, np.median(touches, 0).astype(np.uint8)

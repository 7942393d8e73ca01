"""Views and touches of 40 objects of 10 classes (deep_visuotactile_classification on GitHub).

The sensor is a grey dome of 128 x 128 px seen from inside. A folder holds `objects.csv` (object,
class), `touches.csv` (file, object), `views/OBJECT/`, `touch/OBJECT/` and `untouched.jpg`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from touchgoal.episodes.importers.touch_sets.tables import check_there, has_columns, read_table
from touchgoal.runtime.errors import UserError

_OBJECTS, _TOUCHES = ("object", "class"), ("file", "object")
_PICTURES = {".jpg", ".jpeg", ".png"}


@dataclass(frozen=True, eq=False)
class DomeTouches:
    """n touches and m views of k objects."""

    names: tuple[str, ...]  # objects
    classes: tuple[str, ...]  # sorted
    kind: Int[np.ndarray, " k"]  # class of each object
    untouched: Path  # picture of the untouched sensor
    touches: tuple[Path, ...]
    touch_object: Int[np.ndarray, " n"]
    views: tuple[Path, ...]
    view_object: Int[np.ndarray, " m"]


def is_vt60(folder: Path) -> bool:
    """Return whether a folder holds the two tables of such a set."""
    return has_columns(folder / "objects.csv", _OBJECTS) and has_columns(
        folder / "touches.csv", _TOUCHES
    )


def read_vt60(folder: Path) -> DomeTouches:
    """List a set; UserError if a table, a column or a picture is missing."""
    objects = read_table(folder / "objects.csv", _OBJECTS)
    touches = read_table(folder / "touches.csv", _TOUCHES)
    names = tuple(row["object"] for row in objects)
    classes = tuple(sorted({row["class"] for row in objects}))
    if unknown := {row["object"] for row in touches} - set(names):
        raise UserError(f"{folder / 'touches.csv'}: {min(unknown)} is not in objects.csv")
    files = tuple(folder / row["file"] for row in touches)
    untouched = folder / "untouched.jpg"
    check_there((untouched, *files), folder / "touches.csv")
    views = [_views(folder / "views" / name) for name in names]
    return DomeTouches(
        names=names,
        classes=classes,
        kind=np.array([classes.index(row["class"]) for row in objects]),
        untouched=untouched,
        touches=files,
        touch_object=np.array([names.index(row["object"]) for row in touches]),
        views=tuple(path for own in views for path in own),
        view_object=np.repeat(np.arange(len(names)), [len(own) for own in views]),
    )


def outside_dome(height: int, width: int) -> Bool[np.ndarray, "h w"]:
    """Return the corners of a picture, which show neither the dome nor a touch."""
    y, x = np.mgrid[:height, :width]
    return np.hypot(2 * y / height - 1, 2 * x / width - 1) > 1.15


def inside_dome(height: int, width: int) -> tuple[slice, slice]:
    """Return the rows and columns of a square within the dome, clear of its rim."""
    return slice(round(0.18 * height), round(0.79 * height)), slice(
        round(0.17 * width), round(0.78 * width)
    )


def _views(folder: Path) -> list[Path]:
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    views = [path for path in paths if path.suffix.lower() in _PICTURES]
    if not views:
        raise UserError(f"{folder} holds no view: fetch the set again")
    return views

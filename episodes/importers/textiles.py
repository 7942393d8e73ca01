"""Cloth held by a GelSight, by kind: T6 of TacBench (Sparsh), from active clothing (Yuan et al., ICRA 2018).

Folders `train/CLASS/CLIP/` and `test/CLASS/CLIP/` with `dataset_gelsight.pkl`, a list of encoded pictures, and
`metadata.txt` with lines `label: NUMBER` and `class_name: NAME`. No converter from the original videos was
published: the layout is that of Sparsh's reader. Not known: the pictures' order of colours (taken for RGB),
whether the gel has dots (`gelsight_markers` if so), and whether a clip begins untouched; Sparsh subtracts
nothing there.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from touchgoal.episodes.importers.touch_clip import TouchClip, check_kind, read_pictures
from touchgoal.runtime.errors import UserError

_CLASSES = 20
_MOST_BYTES = 65_536


@dataclass(frozen=True, eq=False)
class TextileClip:
    """One grasp of a piece of cloth.

    Attributes:
        clip: its pictures.
        label: number of its class, 0 to 19.
        name: of its class.
        held_out: of the published test set.
    """

    clip: TouchClip
    label: int
    name: str
    held_out: bool


def read_textiles(folder: Path, sensor: str | None = None) -> Iterator[TextileClip]:
    """The clips of a folder with train/ and test/, one at a time.

    Raises:
        UserError: no such files, another sensor's, or what they hold is not as published.
    """
    layout = "*/*/dataset_gelsight.pkl"
    paths = [p for use in ("train", "test") for p in sorted(folder.glob(f"{use}/{layout}"))]
    if not paths:
        raise UserError(
            f"{folder} holds no train/CLASS/CLIP/dataset_gelsight.pkl: give a folder of textiles"
        )
    named = check_kind(sensor, ("gelsight", "gelsight_markers"), folder)
    for path in paths:
        label, name = _read_metadata(path.with_name("metadata.txt"))
        clip = TouchClip(str(path), named, read_pictures(path))
        held_out = path.parent.parent.parent.name == "test"
        yield TextileClip(clip, label, name or path.parent.parent.name, held_out)


def _read_metadata(path: Path) -> tuple[int, str]:
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES).decode(errors="replace")
    except OSError as error:
        raise UserError(f"{path} is missing, which names the class: {error.strerror}") from error
    label = re.search(r"^\s*label\s*:\s*(\d{1,9})\s*$", text, re.MULTILINE | re.ASCII)
    name = re.search(r"^\s*class_name\s*:\s*(\S.{0,200}?)\s*$", text, re.MULTILINE)
    if label is None or int(label[1]) >= _CLASSES:
        raise UserError(
            f"{path} has no line 'label: NUMBER' with a number from 0 to {_CLASSES - 1}"
        )
    return int(label[1]), name[1] if name else ""

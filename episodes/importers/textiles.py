"""Textile classes with a GelSight: T6 of TacBench (Sparsh), from active clothing (Yuan et al., ICRA 2018).

Folders `train/CLASS/CLIP/` and `test/CLASS/CLIP/` hold `dataset_gelsight.pkl`, a list of encoded images, and
`metadata.txt` with lines `label: NUMBER` and `class_name: NAME`: the layout of Sparsh's reader, for no
converter from the original videos was published. Unknown: the channel order (taken for RGB), whether the gel
has dots (`gelsight_markers` if so), and whether a clip begins without contact; Sparsh subtracts nothing.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from touchgoal.episodes.importers.touch_clip import TouchClip, check_sensor, read_pictures
from touchgoal.runtime.errors import UserError

_CLASSES = 20
_MOST_BYTES = 65_536


@dataclass(frozen=True, eq=False)
class TextileClip:
    """One grasp of a textile."""

    clip: TouchClip  # images
    label: int  # class, 0 to 19
    name: str  # name of the class
    held_out: bool  # whether it belongs to the published test set


def read_textiles(folder: Path, sensor: str | None = None) -> Iterator[TextileClip]:
    """Read the clips of a folder with train/ and test/, one at a time.

    UserError: no such files, another sensor's, or a content that is not as published.
    """
    layout = "*/*/dataset_gelsight.pkl"
    paths = [p for use in ("train", "test") for p in sorted(folder.glob(f"{use}/{layout}"))]
    if not paths:
        raise UserError(
            f"{folder} holds no train/CLASS/CLIP/dataset_gelsight.pkl: give a folder of textiles"
        )
    named = check_sensor(sensor, ("gelsight", "gelsight_markers"), folder)
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

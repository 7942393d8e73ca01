"""Touch, Vision and Language (Fu et al., ICML 2024): SSVTP and HCT, DIGIT touches with captions.

Published layout (github.com/Max-Fu/tvl): `ssvtp/{train,test}.csv` with an image's path in the first
column, `images_rgb/image_N_rgb.jpg`, `images_tac/image_N_tac.jpg`, `text/labels_N.txt`; and
`hct/*/contact.json` beside `{train,test}.csv` with image, touch, untouched sensor and caption in
four columns. Every test press of HCT has other frames in train, so the published split is not kept:
hold presses out to be fair.
"""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from touchgoal.episodes.importers.labelled_videos import check_there
from touchgoal.runtime.errors import UserError

_NUMBER = re.compile(r"image_(\d+)_rgb")


@dataclass(frozen=True)
class CaptionedTouch:
    """One frame of a press, the camera image taken with it, and what it feels like."""

    image: Path
    touch: Path
    untouched: Path | None  # image of the sensor before the press; None in SSVTP
    words: tuple[str, ...]  # adjectives of the caption, lower case
    press: str  # frames with the same one are of one press


def is_tvl(folder: Path) -> bool:
    """Return whether a folder holds one of the two sets."""
    return (folder / "ssvtp").is_dir() or (folder / "hct").is_dir()


def read_tvl(folder: Path) -> list[CaptionedTouch]:
    """List the touches of both sets, those of the published train tables first.

    UserError: neither set is there, or a file that a table names is missing.
    """
    if not is_tvl(folder):
        raise UserError(f"{folder} holds neither ssvtp/ nor hct/: give TVL's top-level folder")
    touches = [
        touch
        for split in ("train", "test")
        for part in (_ssvtp(folder / "ssvtp", split), _hct(folder / "hct", split))
        for touch in part
    ]
    if not touches:
        raise UserError(f"{folder} holds no train.csv with touches: unpack TVL there")
    check_there((path for item in touches for path in (item.image, item.touch)), folder)
    return touches


def _ssvtp(root: Path, split: str) -> Iterator[CaptionedTouch]:
    for row in _rows(root / f"{split}.csv"):
        image = root / row[0]
        if (found := _NUMBER.search(image.name)) is None:
            continue  # the header
        touch = root / row[0].replace("rgb", "tac")
        label = root / "text" / f"labels_{found[1]}.txt"
        if not label.is_file():
            raise UserError(f"{label} is missing: unpack TVL again")
        words = _words(label.read_text(encoding="utf-8").splitlines()[0])
        yield CaptionedTouch(image, touch, None, words, f"ssvtp/{found[1]}")


def _hct(root: Path, split: str) -> Iterator[CaptionedTouch]:
    for contact in sorted(root.glob("*/contact.json")):
        part, table = contact.parent, contact.parent / f"{split}.csv"
        for row in _rows(table)[1:]:
            if len(row) != 4:
                raise UserError(f"{table} has a row of {len(row)} columns; HCT's have 4")
            image, touch, untouched = (part / name for name in row[:3])
            if not untouched.is_file():  # as TVL's own reader does
                untouched = untouched.parents[2] / "digit_background.png"
            press = str(touch.parent.relative_to(root.parent))
            yield CaptionedTouch(
                image, touch, untouched if untouched.is_file() else None, _words(row[3]), press
            )


def _rows(table: Path) -> list[list[str]]:
    if not table.is_file():
        return []
    with table.open(newline="", encoding="utf-8") as file:
        return [row for row in csv.reader(file) if row]


def _words(caption: str) -> tuple[str, ...]:
    return tuple(w for part in caption.replace(".", "").lower().split(",") if (w := part.strip()))

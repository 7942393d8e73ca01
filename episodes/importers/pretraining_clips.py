"""Touch without labels, as Sparsh (Higuera et al. 2024, arXiv 2410.24090) gathers it from four sets.

| folder | pictures | sensor |
|---|---|---|
| YCB-Slide, Touch-Slide | `OBJECT/dataset_N.pkl`, and untouched gels in `bgs/bg_K.jpg` | DIGIT |
| Touch-and-Go | `YYYYMMDD_HHMMSS.pkl` | GelSight of 2017, dotted |
| ObjectFolder Real | `NNN.pkl` | GelSight Mini |

Each pickle is one recording, a list of JPEG or PNG files as bytes. Sources: Sparsh's README (folders,
sensors), its readers and converters (lists of bytes; Touch-and-Go's RGB pictures went through OpenCV's
writer, which takes BGR, and so have red and blue exchanged). Not known: how ObjectFolder's pictures were
written (taken for RGB), whether its gel has dots (name `gelsight_mini_markers` if so), and which way a
DIGIT's picture is turned that lies.

Sparsh subtracts a background from the DIGIT's pictures alone, chosen by a table of its objects. Here it
is the one of `bgs/` that the recording's usual picture is nearest to, so that own objects need no table;
without `bgs/` it is the usual picture itself.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from touchgoal.episodes.importers.touch_clip import (
    TouchClip,
    check_kind,
    read_picture_file,
    read_pictures,
)
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_TRAINED = 0.725  # of GelSight recordings, the longest: Sparsh's train.py
_SLIDES = ("digit",)
_LAYOUTS: dict[str, tuple[str, ...]] = {
    r"\d{8}_\d{6}\.pkl": ("gelsight_markers", "gelsight"),
    r"\d{3}\.pkl": ("gelsight_mini", "gelsight_mini_markers"),
}


@dataclass(frozen=True, eq=False)
class Recording:
    """One unlabelled recording.

    Attributes:
        clip: its pictures.
        held_out: not to be learned from, as published.
        backgrounds: untouched gels, of which one is this sensor's; empty if none are known.
    """

    clip: TouchClip
    held_out: bool
    backgrounds: tuple[Path, ...] = ()

    @property
    def sensor(self) -> str:
        """What recorded it."""
        return self.clip.sensor

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.clip.name

    def frame_checksums(self) -> frozenset[int]:
        """Return checksums of the encoded pictures, comparable in this process."""
        return frozenset(hash(picture.read()) for picture in self.clip.pictures)

    def open(self) -> tuple[TouchClip, UInt8[np.ndarray, "h w 3"]]:
        """Its pictures, decoded when asked for, and the untouched sensor."""
        return self.clip, self.background()

    def background(self) -> UInt8[np.ndarray, "h w 3"]:
        """The sensor untouched, as well as the files know; UserError if `bgs/` is of another size."""
        usual = self.clip.usual()
        if not self.backgrounds:
            return usual
        found = [read_picture_file(path, self.clip.sensor) for path in self.backgrounds]
        fitting = [picture for picture in found if picture.shape == usual.shape]
        if not fitting:
            raise UserError(
                f"no picture in {self.backgrounds[0].parent} is of the size of {self.clip.name}'s: "
                "make them equal"
            )
        return min(fitting, key=lambda picture: np.median(np.abs(usual - picture.astype(int))))


def read_recordings(folder: Path, sensor: str | None = None) -> list[Recording]:
    """The recordings of a published folder.

    Args:
        folder: of one of the layouts.
        sensor: what recorded them, where a layout leaves a choice.

    Raises:
        UserError: the folder is of none of the layouts, of another sensor, or a file is damaged.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder")
    if slides := sorted(folder.glob("*/dataset_*.pkl"), key=_natural):
        slides = [path for path in slides if re.fullmatch(r"dataset_\d+\.pkl", path.name)]
    if slides:
        return _slides(folder, slides, check_kind(sensor, _SLIDES, folder))
    for pattern, kinds in _LAYOUTS.items():
        if paths := sorted(p for p in folder.glob("*.pkl") if re.fullmatch(pattern, p.name)):
            named = check_kind(sensor, kinds, folder)
            return _by_length(folder, paths, named, exchanged=kinds[0] == "gelsight_markers")
    raise UserError(
        f"{folder} is no set of episodes (meta/info.json), and has none of the published layouts: "
        "OBJECT/dataset_0.pkl (YCB-Slide, Touch-Slide), 20220410_031604.pkl (Touch-and-Go), "
        "001.pkl (ObjectFolder), videos with labels.csv (PhysiCLeAR)"
    )


def _slides(folder: Path, paths: list[Path], sensor: str) -> list[Recording]:
    """The last recording of each object is held out, as published: four to learn from, one not."""
    backgrounds = tuple(sorted((folder / "bgs").glob("bg_*.jpg"), key=_natural))
    last = {path.parent: path for path in paths}
    alone = len(last) == len(paths)
    if alone:  # no object has two
        last = {folder: paths[-1]}
    held_out = set(last.values())
    clips = _clips(folder, paths, sensor, exchanged=False)
    return _checked(
        folder,
        [
            Recording(clip, path in held_out, backgrounds)
            for clip, path in zip(clips, paths, strict=True)
        ],
    )


def _by_length(folder: Path, paths: list[Path], sensor: str, exchanged: bool) -> list[Recording]:
    """The longest recordings are learned from, as in Sparsh."""
    clips = _clips(folder, paths, sensor, exchanged)
    order = sorted(range(len(clips)), key=lambda i: -len(clips[i]))
    trained = set(order[: min(max(round(_TRAINED * len(clips)), 1), len(clips) - 1)])
    return _checked(folder, [Recording(clip, i not in trained) for i, clip in enumerate(clips)])


def _clips(folder: Path, paths: list[Path], sensor: str, exchanged: bool) -> list[TouchClip]:
    return [
        TouchClip(str(path), sensor, read_pictures(path), exchanged)
        for path in track(paths, f"files of {folder.name}", "file")
    ]


def _checked(folder: Path, recordings: list[Recording]) -> list[Recording]:
    if len(recordings) < 2:
        raise UserError(
            f"{folder} holds one recording: two at least, to learn from and to judge by"
        )
    return recordings


def _natural(path: Path) -> list[str | int]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", str(path))]

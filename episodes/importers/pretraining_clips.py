"""Touch without labels in the four data sets of Sparsh (Higuera et al. 2024, arXiv 2410.24090).

| folder | images | sensor |
|---|---|---|
| YCB-Slide, Touch-Slide | `OBJECT/dataset_N.pkl`, and untouched gels in `bgs/bg_K.jpg` | DIGIT |
| Touch-and-Go | `YYYYMMDD_HHMMSS.pkl` | GelSight of 2017, dotted |
| ObjectFolder Real | `NNN.pkl` | GelSight Mini |

Each pickle is one recording, a list of JPEG or PNG files as bytes. Sources: Sparsh's README (folders,
sensors), its readers and converters (Touch-and-Go's RGB images went through OpenCV's writer, which takes
BGR, so red and blue are exchanged). Unknown: the channel order of ObjectFolder's images (taken for RGB),
whether its gel has dots (name `gelsight_mini_markers` if so), and how a lying DIGIT image is turned.

Sparsh subtracts a background from DIGIT images only, chosen by a table of its objects. Here it is the
image of `bgs/` nearest to the recording's median image, so that other objects need no table; without
`bgs/` it is the median image itself.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from touchgoal.control.sensors.clip import in_natural_order
from touchgoal.episodes.importers import touch_clip
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_TRAINED = 0.725  # share of GelSight recordings, the longest: Sparsh's train.py
_LAYOUTS: dict[str, tuple[str, ...]] = {
    r"\d{8}_\d{6}\.pkl": ("gelsight_markers", "gelsight"),
    r"\d{3}\.pkl": ("gelsight_mini", "gelsight_mini_markers"),
}


@dataclass(frozen=True)
class Recording:
    """One unlabelled recording; its file is read whole when it is opened."""

    path: Path  # pickle of images
    sensor: str  # sensor model
    held_out: bool  # whether the published split holds it out of training
    exchanged: bool = False  # whether red and blue are exchanged in the file
    backgrounds: tuple[Path, ...] = ()  # untouched gels, one is this sensor's; empty if unknown

    def frame_checksums(self) -> frozenset[int]:
        """Return checksums of the encoded images, comparable in this process."""
        return frozenset(hash(image) for image in touch_clip.read_images(self.path))

    def open(self) -> tuple[touch_clip.TouchClip, UInt8[np.ndarray, "h w 3"]]:
        """Read the images, and the untouched sensor.

        UserError: the file is damaged, or `bgs/` holds images of another size.
        """
        clip = touch_clip.TouchClip(
            str(self.path), self.sensor, touch_clip.read_images(self.path), self.exchanged
        )
        median = clip.median_image()
        if not self.backgrounds:
            return clip, median
        found = [touch_clip.read_image_file(path, self.sensor) for path in self.backgrounds]
        fitting = [image for image in found if image.shape == median.shape]
        if not fitting:
            raise UserError(
                f"no image in {self.backgrounds[0].parent} has the size of {self.path}'s: "
                "make them equal"
            )
        return clip, min(fitting, key=lambda p: np.median(np.abs(median - p.astype(int))))


def read_recordings(folder: Path, sensor: str | None = None) -> list[Recording]:
    """List the recordings of a published folder; `sensor` where the layout leaves a choice.

    UserError: the folder has none of the layouts or another sensor, or a file is damaged.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder")
    slides = in_natural_order(folder.glob("*/dataset_*.pkl"))
    if slides := [path for path in slides if re.fullmatch(r"dataset_\d+\.pkl", path.name)]:
        recordings = _slides(folder, slides, touch_clip.check_sensor(sensor, ("digit",), folder))
    else:
        recordings = _gelsights(folder, sensor)
    if len(recordings) < 2:
        raise UserError(f"{folder} holds one recording: training and validation need one each")
    return recordings


def _slides(folder: Path, paths: list[Path], sensor: str) -> list[Recording]:
    """Hold out the last recording of each object, as published, or the last one of all."""
    backgrounds = tuple(in_natural_order((folder / "bgs").glob("bg_*.jpg")))
    last = {path.parent: path for path in paths}
    held_out = {paths[-1]} if len(last) == len(paths) else set(last.values())
    return [Recording(path, sensor, path in held_out, False, backgrounds) for path in paths]


def _gelsights(folder: Path, sensor: str | None) -> list[Recording]:
    """Hold out the shortest recordings, as Sparsh does."""
    for pattern, sensors in _LAYOUTS.items():
        if paths := sorted(p for p in folder.glob("*.pkl") if re.fullmatch(pattern, p.name)):
            named = touch_clip.check_sensor(sensor, sensors, folder)
            files = track(paths, f"files of {folder.name}", "file")
            length = {path: len(touch_clip.read_images(path)) for path in files}
            order = sorted(paths, key=lambda path: -length[path])
            trained = order[: min(max(round(_TRAINED * len(paths)), 1), len(paths) - 1)]
            exchanged = sensors[0] == "gelsight_markers"
            return [Recording(path, named, path not in trained, exchanged) for path in paths]
    raise UserError(
        f"{folder} is no set of episodes (meta/info.json), and has none of the published layouts: "
        "OBJECT/dataset_0.pkl (YCB-Slide, Touch-Slide), 20220410_031604.pkl (Touch-and-Go), "
        "001.pkl (ObjectFolder), videos with labels.csv (PhysiCLeAR)"
    )

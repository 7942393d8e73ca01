"""Unlabelled videos of a GelSight Mini in the layout of PhysiCLeAR."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8

from touchgoal.episodes.importers.labelled_videos import LabelledVideo, read_labelled_videos
from touchgoal.episodes.touches import touch_background
from touchgoal.runtime.errors import UserError

_LEARNED = "train", "unlabelled"


@dataclass(frozen=True)
class VideoRecording:
    """One video; its ranks are not used."""

    video: LabelledVideo  # video, decoded whole whenever it is opened
    sensor: str = "gelsight_mini"  # sensor model

    @property
    def held_out(self) -> bool:
        """Whether it belongs to the split `val` or `test`."""
        return self.video.split not in _LEARNED

    @property
    def name(self) -> str:
        """Name for messages."""
        return str(self.video.path)

    def frame_checksums(self) -> frozenset[int]:
        """Return checksums of the images, comparable in this process."""
        return frozenset(hash(picture.tobytes()) for picture in self.video.frames())

    def open(self) -> tuple["DecodedVideo", UInt8[np.ndarray, "h w 3"]]:
        """Decode the images, and the untouched sensor: the median of the first five."""
        pictures = self.video.frames()
        return DecodedVideo(pictures), touch_background(pictures)


@dataclass(frozen=True, eq=False)
class DecodedVideo:
    """Images in memory, with the interface of a `TouchClip`."""

    pictures: UInt8[np.ndarray, "n h w 3"]

    def __len__(self) -> int:
        return len(self.pictures)

    def frames(self, rows: Sequence[int] | Int[np.ndarray, " k"]) -> UInt8[np.ndarray, "k h w 3"]:
        """Return the images of these rows."""
        return self.pictures[np.asarray(rows)]


def read_video_recordings(folder: Path) -> list[VideoRecording]:
    """List the videos of a folder with `labels.csv`.

    UserError: the table lacks a column, names a missing video, or has none to train on.
    """
    recordings = [VideoRecording(video) for video in read_labelled_videos(folder)]
    if all(recording.held_out for recording in recordings):
        raise UserError(
            f"{folder} has no video to train on: name the split train or unlabelled in labels.csv"
        )
    return recordings

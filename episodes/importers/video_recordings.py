"""Videos of a GelSight Mini to learn from without labels: PhysiCLeAR's, or one's own in its layout."""

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
    """One video; its ranks are not looked at.

    Attributes:
        video: Decoded whole whenever it is opened.
        sensor: What recorded it.
    """

    video: LabelledVideo
    sensor: str = "gelsight_mini"

    @property
    def held_out(self) -> bool:
        """Not to be learned from: of the split `val` or `test`."""
        return self.video.split not in _LEARNED

    @property
    def name(self) -> str:
        """Name for messages."""
        return str(self.video.path)

    def frame_checksums(self) -> frozenset[int]:
        """Return checksums of the pictures, comparable in this process."""
        return frozenset(hash(picture.tobytes()) for picture in self.video.frames())

    def open(self) -> tuple["DecodedVideo", UInt8[np.ndarray, "h w 3"]]:
        """All its pictures, and the untouched sensor: the median of the first five."""
        pictures = self.video.frames()
        return DecodedVideo(pictures), touch_background(pictures)


@dataclass(frozen=True, eq=False)
class DecodedVideo:
    """Pictures in memory, read as those of a `TouchClip` are."""

    pictures: UInt8[np.ndarray, "n h w 3"]

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.pictures)

    def frames(self, rows: Sequence[int] | Int[np.ndarray, " k"]) -> UInt8[np.ndarray, "k h w 3"]:
        """Pictures of these rows."""
        return self.pictures[np.asarray(rows)]


def read_video_recordings(folder: Path) -> list[VideoRecording]:
    """The videos of a folder with `labels.csv`.

    Raises:
        UserError: the table lacks a column or names a video that is not there, or leaves nothing to learn from.
    """
    recordings = [VideoRecording(video) for video in read_labelled_videos(folder)]
    if all(recording.held_out for recording in recordings):
        raise UserError(
            f"{folder} has no video to learn from: name the split train or unlabelled in labels.csv"
        )
    return recordings

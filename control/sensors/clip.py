"""Recorded videos and folders of images, read the same way by every command. Frames are RGB.

A frame is turned as the video's display matrix says. Colours follow its tags (range and matrix). A
video whose rate varies is resampled to its usual rate, so that frame i is shown at i / fps. What a
reader would have to guess is refused: HDR, transparency, a matrix that is no turn.
"""

import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import av
import av.error
import numpy as np
from av.video.reformatter import Colorspace, VideoReformatter
from jaxtyping import UInt8

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image

IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
VIDEOS = {".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".gif"}
"""Endings of image and of video files that a folder is searched for."""
_UNTOUCHED = "background.png"  # untouched sensor of a folder of presses
_DECODED_AT_ONCE = 64  # frames
_OFF_GRID = 0.5  # frames by which a time stamp may leave the constant rate, as in a set of episodes
_HDR = {16: "PQ", 18: "HLG"}  # transfer characteristics (ITU-T H.273)

_FORMATS = (  # suffixes, first bytes, name
    ((".hdf5", ".h5"), b"\x89HDF\r\n", "HDF5, as robomimic, LIBERO and ALOHA write it"),
    ((".mcap",), b"\x89MCAP0", "an MCAP log"),
    ((".bag",), b"#ROSBAG", "a ROS bag"),
    ((".db3",), b"SQLite format 3", "a ROS 2 bag"),
    ((".npz",), b"PK\x03\x04", "a NumPy archive"),
    ((".npy",), b"\x93NUMPY", "a NumPy array"),
    ((".pkl", ".pickle"), b"\x80\x04\x95", "a Python pickle"),
)
_IMPORTED = (".hdf5", ".mcap", ".bag", ".db3")
_IMPORT = "make a set of episodes of it by touchgoal import-demos"
_CONVERT = "convert it to a LeRobotDataset v3 (docs/data_format.md), or its images to videos or folders of PNG files"


@dataclass(frozen=True)
class Clip:
    """A video file, or a folder of images in natural order (2 before 10), not yet decoded."""

    path: Path
    length: int  # frames
    shape: tuple[int, int]  # height and width, px, upright
    fps: float | None  # frames per second; None for a folder of images
    stamps: tuple[float, ...] = ()  # s from the first frame, of a video whose rate varies

    def frames(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Decode one frame after the other; UserError: a frame is unreadable, or cannot be honoured."""
        if self.path.is_dir():
            yield from _folder_frames(self.path)
        elif not self.stamps or self.fps is None:
            yield from _video_frames(self.path)
        else:  # at each tick the newest frame, as a viewer sees it
            ticks = np.arange(self.length) / self.fps + _OFF_GRID / self.fps
            newest = np.searchsorted(self.stamps, ticks, side="right") - 1
            repeats = np.bincount(newest, minlength=len(self.stamps))
            for frame, count in zip(_video_frames(self.path), repeats, strict=False):
                yield from [frame] * int(count)

    def chunks(self, frames: int) -> Iterator[UInt8[np.ndarray, "n h w 3"]]:
        """Decode the frames in order, at most so many at a time.

        UserError: as `frames`, or a frame is of another size than the first.
        """
        decoded, size = self.frames(), None
        while chunk := list(islice(decoded, frames)):
            size = size or chunk[0].shape
            if any(frame.shape != size for frame in chunk):
                raise UserError(f"{self.path} holds images of different sizes: make them equal")
            yield np.stack(chunk)


def open_clip(path: Path) -> Clip:
    """Open a video file or a folder of images and count its frames.

    UserError: nothing there, or nothing readable.
    """
    if path.is_dir():
        return Clip(path, len(image_files(path)), next(_folder_frames(path)).shape[:2], None)
    if not path.exists():
        raise UserError(f"{path} does not exist: give a video file or a folder of images")
    refuse_other_format(path)
    with _readable(path), av.open(str(path), "r") as container:
        if not container.streams.video:
            raise UserError(f"{path} holds no video stream: give a video file")
        stream = container.streams.video[0]
        rate, base = stream.average_rate, float(stream.time_base or 0)
        packets = [p for p in container.demux(stream) if p.size and not p.is_discard]
        stamps = [p.pts * base for p in packets if p.pts is not None]
    first = next(_video_frames(path), None)
    if first is None or not packets:
        raise UserError(f"{path} holds no frame: record it again")
    fps, length = float(rate) if rate else None, len(packets)
    times = np.sort(stamps) - min(stamps, default=0)
    if len(stamps) < length or length < 3 or _is_constant(times, fps):
        return Clip(path, length, first.shape[:2], fps)
    usual = 1 / float(np.median(np.diff(times)[np.diff(times) > 0]))
    length = round(float(times[-1]) * usual) + 1
    return Clip(path, length, first.shape[:2], usual, tuple(times.tolist()))


def _is_constant(times: np.ndarray, fps: float | None) -> bool:
    return fps is not None and bool(
        (np.abs(times - np.arange(len(times)) / fps) < _OFF_GRID / fps).all()
    )


def read_frames(path: Path) -> tuple[UInt8[np.ndarray, "n h w 3"], float | None]:
    """Read all frames of a video file or of a folder of images.

    Returns RGB frames, and frames per second (None for a folder). UserError: as `open_clip` and
    `Clip.chunks`.
    """
    clip = open_clip(path)
    return np.concatenate(list(clip.chunks(_DECODED_AT_ONCE))), clip.fps


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder, background.png before the others; UserError: there is none."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES]
    if not paths and (folder / "data").is_dir():
        raise UserError(
            f"{folder} holds data/ but no meta/info.json; if it is a set of episodes, run: "
            f"touchgoal repair --fix {folder}"
        )
    for path in () if paths else sorted(folder.iterdir()):
        refuse_other_format(path)
    if not paths:
        raise UserError(f"{folder} holds no image ({', '.join(sorted(IMAGES))})")
    return sorted(in_natural_order(paths), key=lambda path: path.name != _UNTOUCHED)


def in_natural_order(paths: Iterable[Path]) -> list[Path]:
    """Sort paths, numbers in them by value: 2 before 10."""
    return sorted(
        paths, key=lambda path: [(t, int(n or 0)) for t, n in re.findall(r"(\D*)(\d*)", str(path))]
    )


def refuse_other_format(path: Path) -> None:
    """Raise UserError if a file is a recording in one of the formats: its name and the way in."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        begin = file.read(16)
    for suffixes, signature, name in _FORMATS:
        if path.suffix.lower() in suffixes or begin.startswith(signature):
            raise UserError(
                f"{path} is {name}, which is not read here: {_IMPORT if suffixes[0] in _IMPORTED else _CONVERT}"
            )


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except av.error.FFmpegError as error:
        raise UserError(f"{path} is no readable video ({error.strerror}): re-encode it") from error


def _video_frames(path: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    convert = VideoReformatter()  # one for all frames: half the time of a new one each
    with _readable(path), av.open(str(path), "r") as container:
        for i, frame in enumerate(container.decode(video=0)):
            if i == 0:
                _check_format(frame, path)
            yield _upright(rgb_image(convert, frame), frame, path)


def rgb_image(convert: VideoReformatter, frame: av.VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
    """Return a decoded frame as RGB."""
    # asked by default, PyAV before 17 takes BT.709 for BT.601 and the full range for the limited one
    asked = {"src_color_range": frame.color_range, "dst_colorspace": Colorspace.ITU601}
    return convert.reformat(frame, format="rgb24", **asked).to_ndarray()


def _check_format(frame: av.VideoFrame, path: Path) -> None:
    # PyAV tells it from 17 on; lerobot pins an older one, where HDR is refused by its ten bits
    if name := _HDR.get(getattr(frame, "color_trc", -1)):
        raise UserError(f"{path} is HDR ({name}): re-encode it as 8-bit SDR, BT.709")
    channels = frame.format.components
    if any(channel.is_alpha for channel in channels):
        raise UserError(f"{path} has an alpha channel: re-encode it without")
    if (bits := max(channel.bits for channel in channels)) > 8:
        raise UserError(f"{path} has {bits} bits a channel: re-encode it with 8")
    if len(channels) == 1 and not frame.format.has_palette:
        print(f"{path} is grey: measured as RGB with equal channels", file=sys.stderr)


def _upright(
    image: UInt8[np.ndarray, "h w 3"], frame: av.VideoFrame, path: Path
) -> UInt8[np.ndarray, "H W 3"]:
    """Turn and mirror a decoded image as its display matrix (ISO/IEC 14496-12) says."""
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return image
    a, b, _, c, d = np.sign(np.frombuffer(bytes(data), np.int32)[:5])
    if (a, d) == (0, 0) and b and c:
        image, a, d = image.swapaxes(0, 1), c, b
    elif b or c or not (a and d):
        raise UserError(f"{path} is shown at an angle by its display matrix: re-encode it upright")
    return np.ascontiguousarray(image[::d, ::a])


def _folder_frames(folder: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    for path in image_files(folder):
        image = read_image(path)
        if image is None:
            raise UserError(f"{path} is no readable image: remove or replace it")
        yield image

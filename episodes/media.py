"""Video through PyAV, folders of images through OpenCV. Frames are RGB."""

import io
import re
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import av.error
import numpy as np
from av.video.reformatter import VideoReformatter
from jaxtyping import UInt8

from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.picture_file import read_picture

KEY_FRAME_INTERVAL = 2  # frames, so that one frame is found by decoding at most two
# No B frames: presentation order is decoding order and the first time stamp is exactly 0.
_SEEKABLE = {"g": str(KEY_FRAME_INTERVAL), "bf": "0", "preset": "veryfast"}
_PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}


def encode_video(frames: UInt8[np.ndarray, "n h w 3"], fps: float | int) -> bytes:
    """Return an MP4 of lossless H.264 in RGB, whose frame i is shown at i / fps seconds.

    Lossy video changes image embeddings: at crf 18 the image cost of a stored episode differed by 9 to
    15 % from the raw frames', in lossless yuv444p still by 5 %. A simulated image of 128 x 128 takes
    5.5 kB (crf 18: 1.0 kB).
    """
    return _encode(frames, fps, "libx264rgb", "rgb24", {"qp": "0"})


def _encode(
    frames: UInt8[np.ndarray, "n h w 3"],
    fps: float | int,
    codec: str,
    pixels: str,
    quality: dict[str, str],
) -> bytes:
    n, height, width, _ = frames.shape
    if n == 0 or height % 2 or width % 2:
        raise UserError(
            f"cannot encode {n} frames of {height} x {width} as video: give at least one frame of "
            "even height and width"
        )
    rate = Fraction(fps).limit_denominator(1001)
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=rate, options=_SEEKABLE | quality)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        stream.time_base = 1 / rate
        stream.codec_context.thread_count = 1  # the same bytes on every machine
        for i, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = i, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return file.getvalue()


def decode_video(
    video: bytes, fps: float | int, frames: Sequence[int]
) -> UInt8[np.ndarray, "n h w 3"]:
    """Decode the given frames of a video made by `encode_video`, in the given order.

    Only these frames and the key frames before them are decoded.

    UserError: the video has no such frame.
    """
    wanted = sorted(set(frames))
    with av.open(io.BytesIO(video), "r") as container:
        stream = container.streams.video[0]
        pictures = np.empty((len(wanted), stream.height, stream.width, 3), np.uint8)
        stream.codec_context.thread_count = 1  # readers are themselves many
        convert = VideoReformatter()
        decoder, position = container.decode(stream), -1
        for row, target in enumerate(wanted):
            if target > position + KEY_FRAME_INTERVAL:
                container.seek(round(target / fps / (stream.time_base or 1)), stream=stream)
                decoder = container.decode(stream)
            while position != target:
                frame = next(decoder, None)
                position = target + 1 if frame is None else round((frame.time or 0.0) * fps)
                if frame is None or position > target:
                    raise UserError(f"the video has no frame {target}")
                if position == target:
                    pictures[row] = convert.reformat(frame, format="rgb24").to_ndarray()
    return pictures[np.searchsorted(wanted, np.asarray(frames, np.int64))]


def write_video(path: Path, frames: UInt8[np.ndarray, "n h w 3"], fps: float | int) -> None:
    """Write an MP4 (H.264, yuv420p, crf 18) that any browser plays, and make its folder.

    UserError: no frame, or odd height or width.
    """
    data = _encode(frames, fps, "libx264", "yuv420p", {"crf": "18"})
    write_file(path, data)


def read_frames(path: Path) -> tuple[UInt8[np.ndarray, "n h w 3"], float | None]:
    """Read all frames of a video file, or of a folder of images in natural order (2 before 10).

    Returns RGB frames, and frames per second (None for a folder). UserError: nothing there, nothing
    readable, or images of different sizes.
    """
    if path.is_dir():
        return _read_folder(path), None
    if not path.exists():
        raise UserError(f"{path} does not exist: give a video file or a folder of images")
    try:
        with av.open(str(path), "r") as container:
            if not container.streams.video:
                raise UserError(f"{path} holds no video stream: give a video file")
            rate = container.streams.video[0].average_rate
            convert = VideoReformatter()  # one for all frames: half the time of a new one each
            frames = [
                convert.reformat(frame, format="rgb24").to_ndarray()
                for frame in container.decode(video=0)
            ]
    except av.error.FFmpegError as error:
        raise UserError(f"{path} is no readable video ({error.strerror}): re-encode it") from error
    if not frames:
        raise UserError(f"{path} holds no frame: record it again")
    return _stack_equal_sizes(path, frames), float(rate) if rate else None


def _read_folder(folder: Path) -> UInt8[np.ndarray, "n h w 3"]:
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _PICTURES]
    if not paths and (folder / "data").is_dir():
        raise UserError(
            f"{folder} holds data/ but no meta/info.json; if it is a set of episodes, run: "
            f"touchgoal repair --fix {folder}"
        )
    if not paths:
        raise UserError(f"{folder} holds no image ({', '.join(sorted(_PICTURES))})")
    frames = []
    for path in sorted(paths, key=lambda path: _natural_order(path.name)):
        picture = read_picture(path)
        if picture is None:
            raise UserError(f"{path} is no readable image: remove or replace it")
        frames.append(picture)
    return _stack_equal_sizes(folder, frames)


def _natural_order(name: str) -> list[tuple[str, int]]:
    return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name)]


def _stack_equal_sizes(path: Path, frames: list[np.ndarray]) -> UInt8[np.ndarray, "n h w 3"]:
    sizes = {frame.shape for frame in frames}
    if len(sizes) > 1:
        raise UserError(f"{path} holds images of {len(sizes)} different sizes: make them equal")
    return np.stack(frames)

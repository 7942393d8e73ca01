"""Stored videos of episodes, through PyAV. Frames are RGB."""

import io
import tempfile
import zlib
from collections.abc import Sequence
from fractions import Fraction
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from jaxtyping import UInt8

from touchgoal.control.sensors.clip import rgb_image
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

KEY_FRAME_INTERVAL = 2  # frames, so that one frame is found by decoding at most two
# No B frames: presentation order is decoding order and the first time stamp is exactly 0.
_SEEKABLE = {"g": str(KEY_FRAME_INTERVAL), "bf": "0", "preset": "veryfast"}


def encode_video(
    frames: UInt8[np.ndarray, "n h w 3"], fps: float | int, folder: Path | None = None
) -> bytes | mmap:
    """Return an MP4 of lossless H.264 in RGB, whose frame i is shown at i / fps seconds.

    With a folder the video stays in a nameless file there instead of in memory.

    Lossy video changes image embeddings: at crf 18 the image cost of a stored episode differed by 9 to
    15 % from the raw frames', in lossless yuv444p still by 5 %. A simulated image of 128 x 128 takes
    5.5 kB (crf 18: 1.0 kB).
    """
    file = tempfile.TemporaryFile(dir=folder) if folder else io.BytesIO()
    _encode(frames, fps, "libx264rgb", "rgb24", {"qp": "0"}, file)
    if isinstance(file, io.BytesIO):
        return file.getvalue()
    file.flush()
    return mmap(file.fileno(), 0, access=ACCESS_READ)


def _encode(
    frames: UInt8[np.ndarray, "n h w 3"],
    fps: float | int,
    codec: str,
    pixels: str,
    quality: dict[str, str],
    file: Any,
) -> None:
    n, height, width, _ = frames.shape
    if n == 0 or height % 2 or width % 2:
        raise UserError(
            f"cannot encode {n} frames of {height} x {width} as video: give at least one frame of "
            "even height and width"
        )
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=rate, options=_SEEKABLE | quality)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        stream.time_base = 1 / rate
        stream.codec_context.thread_count = 1  # the same bytes on every machine
        for i, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = i, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def decode_video(
    video: bytes | Path, fps: float | int, frames: Sequence[int]
) -> UInt8[np.ndarray, "n h w 3"]:
    """Decode the given frames of a video, in the given order; frame i is shown at i / fps seconds.

    Only these frames and those since the key frame before them are decoded.

    UserError: the video has no such frame.
    """
    wanted, interval = sorted(set(frames)), KEY_FRAME_INTERVAL
    with av.open(io.BytesIO(video) if isinstance(video, bytes) else str(video), "r") as container:
        stream = container.streams.video[0]
        images = np.empty((len(wanted), stream.height, stream.width, 3), np.uint8)
        stream.codec_context.thread_count = 1  # readers are themselves many
        convert = VideoReformatter()
        decoder, position = container.decode(stream), -1
        for row, target in enumerate(wanted):
            if sought := target > position + interval:
                container.seek(round(target / fps / (stream.time_base or 1)), stream=stream)
                decoder = container.decode(stream)
            while position != target:
                frame = next(decoder, None)
                position = target + 1 if frame is None else round((frame.time or 0.0) * fps)
                if sought:  # other encoders set key frames further apart
                    interval, sought = max(interval, target - position), False
                if frame is None or position > target:
                    raise UserError(f"the video has no frame {target}")
                if position == target:
                    images[row] = rgb_image(convert, frame)
    return images[np.searchsorted(wanted, np.asarray(frames, np.int64))]


def video_length(path: Path) -> tuple[int, float]:
    """Return how many frames a video holds, as it states, and its rate, frames per second."""
    with av.open(str(path), "r") as container:
        stream = container.streams.video[0]
        return stream.frames, float(stream.average_rate or 0)


def video_checksum(path: Path, fps: float | int, first: int, length: int) -> int:
    """Return the CRC-32 of `length` encoded frames of a video from frame `first` on, not decoded."""
    checksum = 0
    with av.open(str(path), "r") as container:
        stream = container.streams.video[0]
        scale = float(stream.time_base or 1) * fps
        container.seek(round(first / scale), stream=stream)
        for packet in container.demux(stream):
            if packet.pts is not None and 0 <= round(packet.pts * scale) - first < length:
                checksum = zlib.crc32(bytes(packet), checksum)
            if packet.dts is not None and round(packet.dts * scale) >= first + length:
                break
    return checksum


def write_video(path: Path, frames: UInt8[np.ndarray, "n h w 3"], fps: float | int) -> None:
    """Write an MP4 (H.264, yuv420p, crf 18) that any browser plays, and make its folder.

    UserError: no frame, or odd height or width.
    """
    _encode(frames, fps, "libx264", "yuv420p", {"crf": "18"}, file := io.BytesIO())
    write_file(path, file.getvalue())

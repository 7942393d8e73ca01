"""One reader of recordings: however a clip is stored, its frames and times are the same."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from toy_episodes import moving_blob

from touchgoal.control.sensors.clip import open_clip, read_frames
from touchgoal.control.sensors.fingertip_source import recorded_frames
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import read_image

FPS, LENGTH = 10, 12
FRAMES = moving_blob(LENGTH, 240, 320, 0)[[0, 1, 2, 3, 3, 3, 6, 7, 8, 8, 10, 11]]  # stands twice
SHOWN = [0, 1, 2, 3, 6, 7, 8, 10, 11]  # frames that differ from the one before
BT709, BT601, LIMITED, FULL, PQ = 1, 5, 1, 2, 16


def store(
    path: Path,
    pixels: str = "yuv444p",
    codec: str = "libx264",
    shown: list[int] | None = None,
    turn: int = 0,
    colour_range: int = LIMITED,
    transfer: int = BT709,
    matrix: int = BT709,
) -> Path:
    """Store FRAMES as a video, without loss but for the conversion to `pixels`."""
    stored = np.rot90(FRAMES, turn // 90, (1, 2))
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            codec, rate=FPS, options={"qp": "0", "qmin": "1", "qmax": "1"}
        )
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width, stream.pix_fmt = *stored.shape[1:3], pixels
        stream.codec_context.time_base = Fraction(1, FPS)
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, colour_range
        stream.codec_context.color_trc = transfer
        if turn:
            stream.set_display_rotation(-turn)
        for i in range(LENGTH) if shown is None else shown:
            rgb = av.VideoFrame.from_ndarray(np.ascontiguousarray(stored[i]), format="rgb24")
            frame = rgb.reformat(format=pixels, dst_colorspace=matrix, dst_color_range=colour_range)
            frame.pts, frame.time_base = i, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    "name, options",
    [
        ("upright.mp4", {}),
        ("turned.mov", {"turn": 90}),
        ("upside_down.mp4", {"turn": 180}),
        ("other_side.mp4", {"turn": 270}),
        ("varying.mp4", {"shown": SHOWN}),
        ("full_range.mp4", {"colour_range": FULL}),
        (
            "motion_jpeg.avi",
            {"codec": "mjpeg", "pixels": "yuvj444p", "colour_range": FULL, "matrix": BT601},
        ),
    ],
)
def test_one_clip_stored_in_any_way_gives_the_same_frames_and_times(
    tmp_path: Path, name: str, options: dict
) -> None:
    path = store(tmp_path / name, **options)
    clip, (frames, fps) = open_clip(path), read_frames(path)
    assert fps == pytest.approx(FPS) and clip.length == len(frames) == LENGTH
    assert clip.shape == FRAMES.shape[1:3] == frames.shape[1:3]
    worst = np.abs(frames.astype(int) - FRAMES).mean((1, 2, 3)).max()
    assert worst < 1, "the moving blob is off by more from frame to frame"
    touch = np.stack(list(recorded_frames(path, GELSIGHT_MINI)))
    np.testing.assert_array_equal(touch, frames, "check-sensor reads it so, too")


@pytest.mark.parametrize(
    "options, reason",
    [
        ({"transfer": PQ}, r"HDR \(PQ\): re-encode"),
        ({"pixels": "yuv444p10le"}, "10 bits a channel: re-encode"),
        ({"pixels": "bgra", "codec": "ffv1"}, "an alpha channel: re-encode"),
    ],
)
def test_what_cannot_be_honoured_is_refused_by_name(
    tmp_path: Path, options: dict, reason: str
) -> None:
    path = store(tmp_path / "a.mkv", **options)
    for read in (open_clip, lambda source: list(recorded_frames(source, GELSIGHT_MINI))):
        with pytest.raises(UserError, match=reason):
            read(path)


def test_images_are_turned_and_converted_by_rule(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image, path = FRAMES[0], tmp_path / "a.png"
    turned, exif = Image.fromarray(np.rot90(image)), Image.Exif()
    exif[0x0112] = 6  # orientation: turn by 90 degrees clockwise
    turned.save(path, exif=exif)
    np.testing.assert_array_equal(read_image(path), image)
    Image.fromarray(image).convert("L").save(path)
    grey = read_image(path)
    assert grey is not None and grey.shape == image.shape and not np.ptp(grey, axis=2).any()
    read_image(path)
    assert capsys.readouterr().err.count("grey images") == 1, "said once"
    cv2.imwrite(str(path), np.dstack([image, np.full(image.shape[:2], 255, np.uint8)]))
    assert read_image(path) is not None, "an opaque alpha channel hides nothing"
    for fault, stored in {
        "transparent pixels": np.dstack([image, image[..., 0]]),
        "16 bits a channel": image.astype(np.uint16) * 257,
    }.items():
        cv2.imwrite(str(path), stored)
        with pytest.raises(UserError, match=f"a.png has {fault}: save it"):
            read_image(path)

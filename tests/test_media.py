from pathlib import Path

import cv2
import numpy as np
import pytest

from touchgoal.episodes.media import read_frames, write_video
from touchgoal.runtime.errors import UserError


def moving_ramp(n: int, height: int, width: int) -> np.ndarray:
    i, y, x = np.mgrid[:n, :height, :width]
    return np.stack([60 + 2 * x + 3 * i, 40 + 4 * y, 200 - 2 * x], axis=-1).astype(np.uint8)


def test_video_and_folder_give_the_same_frames(tmp_path: Path) -> None:
    frames = moving_ramp(12, 32, 48)
    write_video(tmp_path / "clips" / "a.mp4", frames, 12.5)
    read, fps = read_frames(tmp_path / "clips" / "a.mp4")
    assert (
        fps == 12.5 and read.shape == frames.shape and np.abs(read - frames.astype(int)).max() < 12
    )
    folder = tmp_path / "pictures"
    folder.mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"view2_{i}.png"), frame[..., ::-1])
    read, fps = read_frames(folder)
    assert fps is None
    np.testing.assert_array_equal(read, frames)


def test_unreadable_media(tmp_path: Path) -> None:
    (tmp_path / "broken.mp4").write_bytes(b"\0" * 500)
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "0.png").write_bytes(b"no picture")
    (tmp_path / "mixed").mkdir()
    for i in (1, 2):
        cv2.imwrite(str(tmp_path / "mixed" / f"{i}.png"), np.zeros((8 * i, 8, 3), np.uint8))
    for name in ("broken.mp4", "empty", "bad", "mixed", "absent.mp4"):
        with pytest.raises(UserError, match=name):
            read_frames(tmp_path / name)
    with pytest.raises(UserError, match="even height"):
        write_video(tmp_path / "odd.mp4", np.zeros((2, 7, 8, 3), np.uint8), 20)

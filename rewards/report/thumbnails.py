"""Small pictures of a trajectory, at most 32 frames of 96 px, collected while it is read."""

import io
import math
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from touchgoal.control.features import IMAGE_PREFIX
from touchgoal.episodes.schema import Episode, is_image

MOST_FRAMES = 32
WIDTH = 96  # px
COLUMNS = 8  # pictures in a row of a sheet
_QUALITY = 70  # of JPEG


class Thumbnails:
    """Evenly spaced frames of each camera and fingertip."""

    def __init__(self, length: int) -> None:
        """Plan for a trajectory of so many frames."""
        count = min(length, MOST_FRAMES)
        self._planned: list[int] = np.linspace(0, length - 1, count).round().astype(int).tolist()
        self._pictures: dict[str, list[np.ndarray]] = {}

    @property
    def shown(self) -> list[int]:
        """The frames that were collected; fewer than planned where a video ended early."""
        return self._planned[: len(next(iter(self._pictures.values()), []))]

    def collect(self, chunks: Iterable[Episode]) -> Iterator[Episode]:
        """Pass consecutive chunks of the trajectory on."""
        start = 0
        for chunk in chunks:
            rows = [t - start for t in self._planned if start <= t < start + len(chunk)]
            for key in filter(is_image, chunk.frames):
                small = [_shrunk(chunk.frames[key][row]) for row in rows]
                self._pictures.setdefault(key.removeprefix(IMAGE_PREFIX), []).extend(small)
            start += len(chunk)
            yield chunk

    def sheets(self) -> dict[str, UInt8[np.ndarray, " bytes"]]:
        """Return a JPEG of each camera and fingertip: its frames in rows of 8, from the top left."""
        return {name: _sheet(pictures) for name, pictures in self._pictures.items()}


def last_of(sheet: UInt8[np.ndarray, " bytes"], count: int) -> bytes:
    """Return the last of the `count` pictures of a sheet as a JPEG of its own."""
    with Image.open(io.BytesIO(sheet.tobytes())) as image:
        height = image.height // math.ceil(count / COLUMNS)
        row, column = divmod(count - 1, COLUMNS)
        corner = column * WIDTH, row * height
        box = (*corner, corner[0] + WIDTH, corner[1] + height)
        return _jpeg(np.asarray(image.crop(box)))


def _shrunk(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "y x 3"]:
    height = max(round(WIDTH * picture.shape[0] / picture.shape[1]), 1)
    return np.asarray(cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA))


def _sheet(pictures: list[np.ndarray]) -> UInt8[np.ndarray, " bytes"]:
    height, width, _ = pictures[0].shape
    columns, rows = min(len(pictures), COLUMNS), math.ceil(len(pictures) / COLUMNS)
    sheet = np.zeros((rows * height, columns * width, 3), np.uint8)
    for i, picture in enumerate(pictures):
        row, column = divmod(i, COLUMNS)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = picture
    return np.frombuffer(_jpeg(sheet), np.uint8)


def _jpeg(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=_QUALITY)
    return file.getvalue()

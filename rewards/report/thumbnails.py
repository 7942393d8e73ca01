"""Small images of a trajectory, at most 32 frames, collected while it is read."""

import io
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from touchgoal.control.features import IMAGE_PREFIX
from touchgoal.episodes.schema import Episode, is_image

MOST_FRAMES = 32
_HEIGHT, _LONE_HEIGHT = 96, 168  # px at most, of several cameras and fingertips, and of a lone one
COLUMNS = 8  # images in a row of a sheet
_QUALITY = 70  # of JPEG


class Thumbnails:
    """Evenly spaced frames of each camera and fingertip."""

    def __init__(self, length: int, height: int = _HEIGHT) -> None:
        """Plan for a trajectory of so many frames; `height` in px, at most."""
        self._height = height
        count = min(length, MOST_FRAMES)
        self.planned: list[int] = np.linspace(0, length - 1, count).round().astype(int).tolist()
        self._images: dict[str, list[np.ndarray]] = {}

    @property
    def shown(self) -> list[int]:
        """The frames that were collected; fewer than planned where a video ended early."""
        return self.planned[: len(next(iter(self._images.values()), []))]

    def collect(self, chunks: Iterable[Episode]) -> Iterator[Episode]:
        """Pass consecutive chunks of the trajectory on."""
        start = 0
        for chunk in chunks:
            rows = [t - start for t in self.planned if start <= t < start + len(chunk)]
            self.add(replace(chunk, frames={k: v[rows] for k, v in chunk.frames.items()}))
            start += len(chunk)
            yield chunk

    def add(self, planned: Episode) -> None:
        """Add planned frames; only where the trajectory is not read as a whole, all of them at once."""
        keys = list(filter(is_image, planned.frames))
        height = _LONE_HEIGHT if len(keys) == 1 else self._height
        for key in keys:
            small = [_shrunk(image, height) for image in planned.frames[key]]
            self._images.setdefault(key.removeprefix(IMAGE_PREFIX), []).extend(small)

    def sheets(self) -> dict[str, UInt8[np.ndarray, " bytes"]]:
        """Return a JPEG of each camera and fingertip: its frames in rows of 8, from the top left."""
        return {name: _sheet(images) for name, images in self._images.items()}


def last_of(sheet: UInt8[np.ndarray, " bytes"], count: int) -> bytes:
    """Return the last of the `count` images of a sheet as a JPEG of its own."""
    with Image.open(io.BytesIO(sheet.tobytes())) as image:
        width, height = (
            image.width // min(count, COLUMNS),
            image.height // math.ceil(count / COLUMNS),
        )
        row, column = divmod(count - 1, COLUMNS)
        box = column * width, row * height, (column + 1) * width, (row + 1) * height
        return _jpeg(np.asarray(image.crop(box)))


def _shrunk(image: UInt8[np.ndarray, "h w 3"], most: int) -> UInt8[np.ndarray, "y x 3"]:
    height = min(most, len(image))
    width = max(round(height * image.shape[1] / len(image)), 1)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def _sheet(images: list[np.ndarray]) -> UInt8[np.ndarray, " bytes"]:
    height, width, _ = images[0].shape
    columns, rows = min(len(images), COLUMNS), math.ceil(len(images) / COLUMNS)
    sheet = np.zeros((rows * height, columns * width, 3), np.uint8)
    for i, image in enumerate(images):
        row, column = divmod(i, COLUMNS)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = image
    return np.frombuffer(_jpeg(sheet), np.uint8)


def _jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=_QUALITY)
    return file.getvalue()

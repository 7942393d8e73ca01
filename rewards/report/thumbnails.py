"""Small images of a trajectory, at most 32 frames, collected while it is read."""

import io
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from touchgoal.control.features import IMAGE_PREFIX
from touchgoal.episodes.schema import Episode, is_image

MOST_FRAMES = 32
_HEIGHT, LONE_HEIGHT = 96, 168  # px at most, of several cameras and fingertips, and of a lone one
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
        height = LONE_HEIGHT if len(keys) == 1 else self._height
        for key in keys:
            small = [_shrunk(image, height) for image in planned.frames[key]]
            self._images.setdefault(key.removeprefix(IMAGE_PREFIX), []).extend(small)

    def sheets(self) -> dict[str, UInt8[np.ndarray, " bytes"]]:
        """Return a JPEG of each camera and fingertip: its frames in rows of 8, from the top left."""
        return {name: _sheet(images) for name, images in self._images.items()}

    def last(self) -> UInt8[np.ndarray, " bytes"]:
        """Return the last frame of the first camera as a JPEG."""
        return _jpeg(next(iter(self._images.values()))[-1])


def _shrunk(image: UInt8[np.ndarray, "h w 3"], most: int) -> UInt8[np.ndarray, "y x 3"]:
    height = min(most, len(image))
    width = max(round(height * image.shape[1] / len(image)), 1)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def _sheet(images: list[np.ndarray]) -> UInt8[np.ndarray, " bytes"]:
    columns = min(len(images), COLUMNS)
    black = [np.zeros_like(images[0])] * (-len(images) % columns)
    rows = np.stack([*images, *black]).reshape(-1, columns, *images[0].shape)
    return _jpeg(np.concatenate([np.concatenate(row, axis=1) for row in rows]))


def _jpeg(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, " bytes"]:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=_QUALITY)
    return np.frombuffer(file.getvalue(), np.uint8)

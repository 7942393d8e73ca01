"""Images of one fingertip as published files hold them: encoded, and decoded when asked for."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image as PILImage

from touchgoal.control.arrays import Image
from touchgoal.control.sensors.image_integrity import JpegDecoder
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.episodes.importers.plain_pickle import read_plain_pickle
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import decode_image

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"  # the last chunk with its checksum
_MEDIAN_IMAGES = 25  # spread over a clip, for its untouched gel


@dataclass(frozen=True, eq=False)
class TouchClip:
    """Images of one fingertip, in time."""

    name: str  # name for messages
    sensor: str  # `control.tactile.sensor_models.SensorModel.name`
    images: Sequence[bytes]  # JPEG or PNG files
    red_and_blue_exchanged: bool = False  # whether the writer took RGB for BGR

    def __len__(self) -> int:
        return len(self.images)

    def frames(self, rows: Sequence[int] | Int[np.ndarray, " n"]) -> UInt8[np.ndarray, "n h w 3"]:
        """Return RGB images, turned as the sensor's model: a DIGIT's upright, a GelSight's lying.

        UserError: one of them is broken, or of another size than the others.
        """
        images = []
        for row in map(int, rows):
            image = decode(self.images[row], f"image {row} of {self.name}")
            image = image[:, :, ::-1] if self.red_and_blue_exchanged else image
            images.append(turned(image, self.sensor))
        if len({image.shape for image in images}) > 1:
            raise UserError(f"{self.name} holds images of different sizes: make them equal")
        return np.stack(images)

    def median_image(self) -> Image:
        """Return the median of images spread over the clip: the untouched gel where contact moves."""
        rows = np.linspace(0, len(self) - 1, min(_MEDIAN_IMAGES, len(self))).astype(int)
        return np.median(self.frames(rows), 0).astype(np.uint8)


def decode(data: bytes, name: str) -> Image:
    """Decode a JPEG or PNG file; `name` is for the message.

    UserError: it is neither, too large, or damaged: a PNG is compared with its checksums, a JPEG
    must decode without a warning.
    """
    whole = data[:8] == _PNG and _is_whole_png(data)
    if whole or data[:2] == _JPEG:
        image = decode_image(data, name)  # first, because it refuses what is too large
        if image is not None and (whole or JpegDecoder().decode(data) is not None):
            return image
    raise UserError(f"{name} is broken, or no JPEG or PNG: get the file again")


def _is_whole_png(data: bytes) -> bool:
    """Return whether every chunk's checksum is right, up to the last."""
    try:
        with PILImage.open(io.BytesIO(data)) as image:
            image.verify()
    except PILImage.DecompressionBombError:
        return True  # `decode_image` names its size
    except (OSError, SyntaxError, ValueError):
        return False
    return data[-12:] == _PNG_END


def turned(image: Image, sensor: str) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image in the orientation of the sensor's model.

    A lying DIGIT image is turned clockwise, as Sparsh's reader does; an upright GelSight image is
    turned back, counter-clockwise. No source states whether that is right or half a turn off.
    """
    height, width = SENSORS[sensor].image_shape
    if (image.shape[0] > image.shape[1]) == (height > width):
        return image
    return np.ascontiguousarray(np.rot90(image, -1 if height > width else 1))


def read_images(path: Path) -> list[bytes]:
    """Return the list of encoded images that a pickle holds.

    UserError: it is no such list, or an empty one.
    """
    return encoded_images(read_plain_pickle(path), str(path))


def encoded_images(value: object, name: str) -> list[bytes]:
    """Return a value that is to be a list of encoded images; `name` is for the message."""
    if not isinstance(value, list) or not all(isinstance(item, bytes) for item in value):
        raise UserError(f"{name} is not a list of encoded images: get it again, as published")
    if not value:
        raise UserError(f"{name} holds no image")
    return value


def read_image_file(path: Path, sensor: str) -> Image:
    """Read an image file, in the orientation of the sensor's model.

    UserError: it is missing or broken.
    """
    try:
        return turned(decode(path.read_bytes(), str(path)), sensor)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def check_sensor(sensor: str | None, possible: tuple[str, ...], folder: Path) -> str:
    """Return the sensor of a layout: the one named, if it is possible, else the first possible one.

    UserError: the layout is another sensor's.
    """
    if sensor is None:
        return possible[0]
    if sensor not in possible:
        raise UserError(f"{folder} was recorded with {' or '.join(possible)}, not {sensor}")
    return sensor

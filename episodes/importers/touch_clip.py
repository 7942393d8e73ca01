"""Pictures of one fingertip as published files hold them: encoded, and left there until asked for."""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8

from touchgoal.control.sensors.picture_integrity import JpegDecoder
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.episodes.importers.plain_pickle import StoredBytes, read_plain_pickle
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.picture_file import decode_picture

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_LOOKS = 25  # pictures from all over a clip by which its untouched gel is found

Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class TouchClip:
    """Pictures of one fingertip, in time.

    Attributes:
        name: for messages.
        sensor: `control.tactile.sensor_models.SensorModel.name`.
        pictures: JPEG or PNG files.
        red_and_blue_exchanged: whoever wrote them took RGB for BGR.
    """

    name: str
    sensor: str
    pictures: Sequence[StoredBytes]
    red_and_blue_exchanged: bool = False

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.pictures)

    def frames(self, rows: Sequence[int] | Int[np.ndarray, " n"]) -> UInt8[np.ndarray, "n h w 3"]:
        """RGB pictures, as the sensor's model has them: a DIGIT's upright, a GelSight's lying.

        Raises:
            UserError: one of them is broken, or of another size than the others.
        """
        pictures = [self._frame(int(row)) for row in rows]
        if len({picture.shape for picture in pictures}) > 1:
            raise UserError(f"{self.name} holds pictures of different sizes: make them equal")
        return np.stack(pictures)

    def usual(self) -> Picture:
        """The median of pictures from all over the clip: untouched, where touch comes and goes."""
        rows = np.linspace(0, len(self) - 1, min(_LOOKS, len(self))).astype(int)
        return np.median(self.frames(rows), 0).astype(np.uint8)

    def _frame(self, row: int) -> Picture:
        name = f"picture {row} of {self.name}"
        picture = decode(self.pictures[row].read(), name)
        if self.red_and_blue_exchanged:
            picture = picture[:, :, ::-1]
        return turned(picture, self.sensor)


def decode(data: bytes, name: str) -> Picture:
    """The picture in a JPEG or PNG file.

    Raises:
        UserError: it is neither, too large, or broken as far as its kind shows: every byte of a PNG
            is checked, of a JPEG what makes its decoder stumble.
    """
    whole = data[:8] == _PNG and _is_whole_png(data)
    if whole or data[:2] == _JPEG:
        picture = decode_picture(data, name)  # first, for it refuses what is too large
        if picture is not None and (whole or JpegDecoder().decode(data) is not None):
            return picture
    raise UserError(f"{name} is broken, or no JPEG or PNG: get the file again")


def _is_whole_png(data: bytes) -> bool:
    """Whether every chunk's checksum is right, up to the last."""
    at = len(_PNG)
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        end = at + 8 + size
        if end + 4 > len(data) or data[end : end + 4] != struct.pack(
            ">I", zlib.crc32(data[at + 4 : end])
        ):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return end + 4 == len(data)
        at = end + 4
    return False


def turned(picture: Picture, sensor: str) -> UInt8[np.ndarray, "height width 3"]:
    """A picture as the sensor's model has it.

    A DIGIT's that lies is turned clockwise, as Sparsh's reader does; a GelSight's that stands is turned
    back, counter-clockwise. Nobody says whether that is right or half a turn off.
    """
    height, width = SENSORS[sensor].image_shape
    if (picture.shape[0] > picture.shape[1]) == (height > width):
        return picture
    return np.ascontiguousarray(np.rot90(picture, -1 if height > width else 1))


def read_pictures(path: Path) -> list[StoredBytes]:
    """The list of encoded pictures that a pickle holds.

    Raises:
        UserError: it is no such list, or an empty one.
    """
    return stored_pictures(read_plain_pickle(path), str(path))


def stored_pictures(value: object, name: str) -> list[StoredBytes]:
    """A value that is to be a list of encoded pictures; `name` is for the message."""
    if not isinstance(value, list) or not all(isinstance(item, StoredBytes) for item in value):
        raise UserError(f"{name} holds something else than a list of encoded pictures")
    if not value:
        raise UserError(f"{name} holds no picture")
    return value


def read_picture_file(path: Path, sensor: str) -> Picture:
    """A picture in a file of its own, as the sensor's model has it.

    Raises:
        UserError: there is none, or it is broken.
    """
    try:
        return turned(decode(path.read_bytes(), str(path)), sensor)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def check_kind(sensor: str | None, kinds: tuple[str, ...], folder: Path) -> str:
    """The sensor of a layout's pictures: the one named, if it can be, else the first that can.

    Raises:
        UserError: they are another sensor's.
    """
    if sensor is None:
        return kinds[0]
    if sensor not in kinds:
        raise UserError(f"{folder} was recorded with {' or '.join(kinds)}, not {sensor}")
    return sensor

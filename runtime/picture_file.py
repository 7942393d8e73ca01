"""Image files: reading those of unknown origin, and writing without silent failures."""

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

_MOST_PIXELS = 50_000_000  # a small file may unpack to gigabytes


def read_picture(path: Path) -> UInt8[np.ndarray, "h w 3"] | None:
    """Read the RGB image of a file; None if it is missing or unreadable.

    UserError: it has more than 50 million pixels.
    """
    try:
        return decode_picture(path.read_bytes(), str(path))
    except OSError:
        return None


def decode_picture(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"] | None:
    """Decode an image file's bytes, as `read_picture`; `name` is for the message."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as picture:  # reads the header alone
                width, height = picture.size
        size = f"{width} x {height} pixels" if width * height > _MOST_PIXELS else ""
    except Image.DecompressionBombError:
        size = "far too many pixels"
    except (OSError, ValueError, SyntaxError):
        return None
    if size:
        raise UserError(f"{name} has {size}: make it smaller than {_MOST_PIXELS / 1e6:.0f} million")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def write_picture(path: Path, picture: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image as `atomic_write` does; cv2.imwrite would hide a full disk."""
    write_file(path, cv2.imencode(path.suffix, picture[..., ::-1])[1].tobytes())

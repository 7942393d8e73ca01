"""Image files: reading those of unknown origin, and writing without silent failures."""

import io
import sys
import warnings
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

_MOST_PIXELS = 50_000_000  # a small file may unpack to gigabytes


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"] | None:
    """Read the RGB image of a file; None if it is missing or unreadable.

    A grey image gets three equal channels, which is said on stderr. UserError: it has more than 50
    million pixels, transparent ones, or more than 8 bits a channel.
    """
    try:
        return decode_image(path.read_bytes(), str(path))
    except OSError:
        return None


def decode_image(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"] | None:
    """Decode an image file's bytes, as `read_image`; `name` is for the message."""
    alpha = False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as opened:  # reads the header alone
                width, height = opened.size
                alpha = "A" in opened.mode or "transparency" in opened.info
                if alpha and width * height <= _MOST_PIXELS:
                    alpha = np.asarray(opened.convert("RGBA"))[..., 3].min() < 255
        size = f"{width} x {height} pixels" if width * height > _MOST_PIXELS else ""
    except Image.DecompressionBombError:
        size = "far too many pixels"
    except (OSError, ValueError, SyntaxError):
        return None
    if size:
        raise UserError(f"{name} has {size}: make it smaller than {_MOST_PIXELS / 1e6:.0f} million")
    try:
        # Turned as its EXIF orientation says; 16 bits and one channel are kept, to be seen.
        as_stored = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
        image = cv2.imdecode(np.frombuffer(data, np.uint8), as_stored)
    except cv2.error:
        return None
    if image is None:
        return None
    if alpha:
        raise UserError(f"{name} has transparent pixels: save it without an alpha channel")
    if image.dtype != np.uint8:
        raise UserError(f"{name} has {8 * image.itemsize} bits a channel: save it with 8")
    if image.ndim == 2:
        parent = Path(name).parent
        _say_grey(name if parent == Path() else str(parent))
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@cache
def _say_grey(where: str) -> None:
    """Say once a folder that its images are grey."""
    print(f"{where}: grey images are measured as RGB with equal channels", file=sys.stderr)


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image as `atomic_write` does; cv2.imwrite would hide a full disk."""
    write_file(path, cv2.imencode(path.suffix, image[..., ::-1])[1].tobytes())

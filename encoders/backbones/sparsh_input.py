"""Preprocessing of the published Sparsh encoders (Higuera et al. 2024, appendix B)."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from touchgoal.runtime.errors import UserError

SPARSH, SPARSH_PLAIN = "sparsh/v1", "sparsh-plain/v1"
"""With background subtraction, as Sparsh for DIGIT and GelSight Mini, and without, as for the GelSight
of 2017."""
_HEIGHT, _WIDTH = 4, 3  # proportions of an upright image
_GREY = 127  # grey level of an unchanged pixel: 255 * 0.5, rounded down


@dataclass(frozen=True)
class SparshPreprocessor:
    """Input of Sparsh: an upright 4:3 image, 0 to 1, in which an untouched sensor is grey.

    Each channel is the change in grey levels plus 127, clipped to 0 to 255. Landscape images are
    rotated clockwise, others than 4:3 cropped about the centre, and resized bilinearly as PIL does.
    Mean and variance are not normalised, and a change of the light stays in, as published.
    """

    size: tuple[int, int]  # rows, columns of the output, px: 320 x 240; learned positions 224 x 224
    subtract: bool = True  # subtract the untouched sensor
    sensor: None = None  # any sensor

    @classmethod
    def of(cls, identity: str, size: tuple[int, int]) -> "SparshPreprocessor":
        """Return the preprocessor of an identity; UserError for an unknown one."""
        if identity not in (SPARSH, SPARSH_PLAIN):
            raise UserError(f"no preprocessor {identity}: this is {SPARSH} and {SPARSH_PLAIN}")
        return cls(size, identity == SPARSH)

    @property
    def id(self) -> str:
        """Return the identity with the size."""
        rows, columns = self.size
        return f"{SPARSH if self.subtract else SPARSH_PLAIN}/{rows}x{columns}"

    def __call__(
        self, frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
    ) -> Float32[np.ndarray, "n 3 H W"]:
        """Preprocess frames, given the untouched sensor."""
        rows, columns = self.size
        out = np.empty((len(frames), 3, rows, columns), np.float32)
        shifted = background.astype(np.int16) - _GREY
        for i, frame in enumerate(frames):
            # cv2 cuts to 0 and 255
            change = cv2.subtract(frame, shifted, dtype=cv2.CV_8U) if self.subtract else frame
            image = Image.fromarray(_upright(change))
            small = image.resize((columns, rows), Image.Resampling.BILINEAR)
            np.divide(np.asarray(small).transpose(2, 0, 1), np.float32(255), out=out[i])
        return out


def _upright(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Return the image in portrait format, cropped to 4:3 about the centre."""
    if image.shape[0] < image.shape[1]:
        image = np.rot90(image, -1)
    h, w, _ = image.shape
    height, width = min(h, w * _HEIGHT // _WIDTH), min(w, h * _WIDTH // _HEIGHT)
    top, left = (h - height) // 2, (w - width) // 2
    return np.ascontiguousarray(image[top : top + height, left : left + width])

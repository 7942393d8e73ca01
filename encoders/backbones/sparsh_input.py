"""Raw frames to what the published Sparsh encoders take (Higuera et al. 2024, appendix B)."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from touchgoal.runtime.errors import UserError

SPARSH, SPARSH_PLAIN = "sparsh/v1", "sparsh-plain/v1"
"""With the background subtracted, as Sparsh has it for the DIGIT and the GelSight Mini; without, as for the
GelSight of 2017."""
_HEIGHT, _WIDTH = 4, 3  # of an upright picture
_GREY = 127  # of an unchanged pixel: 255 * 0.5, rounded down


@dataclass(frozen=True)
class SparshPreprocessor:
    """Change about grey, turned upright, 4:3, resized, 0 to 1; no mean or spread is taken out.

    Of every colour the change against the untouched sensor, in grey levels, plus 127, cut to 0 and 255.
    Lying pictures are turned clockwise, others than 4:3 cut about the centre, and resized as PIL does it,
    bilinear and over the area that a pixel covers. All of it before numbers are broken, so that a frame of
    320 x 240 loses nothing.

    Attributes:
        size: Height and width of the output, px: 320 x 240 as trained, 224 x 224 for learned positions.
        subtract: Take the untouched sensor out; otherwise the frames are seen as they are.
        sensor: None: any that takes pictures of its gel.
    """

    size: tuple[int, int]
    subtract: bool = True
    sensor: None = None

    @classmethod
    def of(cls, identity: str, size: tuple[int, int]) -> "SparshPreprocessor":
        """The one that a configuration names; UserError for an unknown name."""
        if identity not in (SPARSH, SPARSH_PLAIN):
            raise UserError(f"no preprocessor {identity}: this is {SPARSH} and {SPARSH_PLAIN}")
        return cls(size, identity == SPARSH)

    @property
    def id(self) -> str:
        """Names what it does, and the size."""
        rows, columns = self.size
        return f"{SPARSH if self.subtract else SPARSH_PLAIN}/{rows}x{columns}"

    def __call__(
        self, frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
    ) -> Float32[np.ndarray, "n 3 H W"]:
        """See Preprocessor."""
        rows, columns = self.size
        out = np.empty((len(frames), 3, rows, columns), np.float32)
        shifted = background.astype(np.int16) - _GREY
        for i, frame in enumerate(frames):
            # cv2 cuts to 0 and 255
            seen = cv2.subtract(frame, shifted, dtype=cv2.CV_8U) if self.subtract else frame
            picture = Image.fromarray(_upright(seen))
            small = picture.resize((columns, rows), Image.Resampling.BILINEAR)
            np.divide(np.asarray(small).transpose(2, 0, 1), np.float32(255), out=out[i])
        return out


def _upright(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Higher than wide, and the largest 4:3 about the centre."""
    if picture.shape[0] < picture.shape[1]:
        picture = np.rot90(picture, -1)
    h, w, _ = picture.shape
    height, width = min(h, w * _HEIGHT // _WIDTH), min(w, h * _WIDTH // _HEIGHT)
    top, left = (h - height) // 2, (w - width) // 2
    return np.ascontiguousarray(picture[top : top + height, left : left + width])

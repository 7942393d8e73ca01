"""Preprocessing of raw fingertip frames: the same numbers in training, tests and deployment."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.control.tactile.sensor_models import find_model
from touchgoal.encoders.backbones.sparsh_input import SparshPreprocessor
from touchgoal.runtime.errors import UserError

SCALE = 16.0  # grey levels (of 255) that become 1.0; about the contrast of a firm contact
_ASPECT_TOLERANCE = 0.02  # a GelSight Mini's own 3280 x 2464 differs from 4:3 by 0.2 %


@dataclass(frozen=True)
class TactilePreprocessor:
    """Removal of light changes, subtraction of the untouched sensor, resizing and scaling.

    Any change of the output in steady light needs a new version: encoders refuse to load under
    another preprocessor than they were trained with.
    """

    sensor: str  # `SensorModel.name`
    version: int  # version of the numbers
    size: tuple[int, int]  # height and width of the output, px

    @property
    def id(self) -> str:
        """Return sensor and version, e.g. "gelsight_mini/v1"."""
        return f"{self.sensor}/v{self.version}"

    def __call__(
        self, frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
    ) -> Float32[np.ndarray, "n 3 H W"]:
        """Return the signed change against the untouched sensor; zero without contact.

        A gain of the light is removed first (`light_gain`). Pixels are averaged over their area
        (interpolated if the frames are smaller than the output) after the subtraction, so that
        rounding keeps faint contacts.

        UserError: the frames have another aspect ratio than the sensor's.
        """
        self._check(frames.shape[1:3])
        h, w = self.size
        out = np.empty((len(frames), 3, h, w), np.float32)
        shrinks = frames.shape[1] >= h and frames.shape[2] >= w
        interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        untouched = background.astype(np.float32)
        for i, frame in enumerate(frames):
            change = (remove_gain(frame, untouched) - untouched) / np.float32(SCALE)
            out[i] = cv2.resize(change, (w, h), interpolation=interpolation).transpose(2, 0, 1)
        return out

    def _check(self, shape: tuple[int, ...]) -> None:
        aspect, expected = shape[1] / shape[0], self.size[1] / self.size[0]
        if abs(aspect / expected - 1) > _ASPECT_TOLERANCE:
            raise UserError(
                f"a {self.sensor} frame is {expected:.2f} times as wide as high, these are "
                f"{shape[1]}x{shape[0]}: crop them, or choose the right sensor"
            )


def check_images(name: str, images: object, ndim: tuple[int, ...]) -> None:
    """Raise UserError, in one line, unless these are RGB images.

    Args:
        name: Their name in the message.
        images: Expected are uint8 numpy arrays, (height, width, 3) or (n, height, width, 3).
        ndim: Allowed numbers of axes: 3, 4 or both.
    """
    shapes = " or ".join({3: "(height, width, 3)", 4: "(n, height, width, 3)"}[n] for n in ndim)
    expected = f"{name} must be RGB images as a numpy array of uint8 (0 to 255), {shapes}"
    if not isinstance(images, np.ndarray):
        kind = type(images)
        hint = ": tensor.cpu().numpy()" if kind.__module__ == "torch" else ""
        raise UserError(f"{expected}, not a {kind.__module__}.{kind.__qualname__}{hint}")
    if images.dtype != np.uint8:
        unit = np.issubdtype(images.dtype, np.floating)
        hint = ": values of 0 to 1 become (255 * images).round().astype(np.uint8)" if unit else ""
        raise UserError(f"{expected}, not of {images.dtype}{hint}")
    if images.ndim not in ndim or images.shape[-1] != 3:
        first = images.ndim in (3, 4) and images.shape[-3] == 3
        hint = ": put the colours last, np.moveaxis(images, -3, -1)" if first else ""
        raise UserError(f"{expected}, not of shape {images.shape}{hint}")
    if 0 in images.shape:
        raise UserError(f"{expected}, and at least one: these have shape {images.shape}")


Preprocessor = TactilePreprocessor | SparshPreprocessor

_SIDES = {1: (120, 160), 3: (240, 320), 4: (192, 256)}  # version -> shorter and longer side, px


def preprocessor_for(sensor: str, version: int = 1) -> TactilePreprocessor:
    """Return a preprocessor of a sensor; UserError for an unknown one.

    Version 1 gives 120 x 160 px of a sensor of 4:3, version 3 240 x 320, version 4 192 x 256.
    """
    rows, columns = find_model(sensor).image_shape
    if version not in _SIDES:
        raise UserError(f"this version of touchgoal has no preprocessor {sensor}/v{version}")
    short, long = _SIDES[version]
    size = (short, long) if rows < columns else (long, short)
    return TactilePreprocessor(sensor, version, size)

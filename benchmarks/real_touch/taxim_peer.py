"""The taxim wheel: real GelSight presses with hand-drawn circles, and a table-based simulator.

taxim 1.4.1 (MIT) is Tim Schneider's port of Taxim (Si and Yuan 2022). Its tables were made from the
presses that ship with it.
"""

import importlib.util
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.calibration.ball import Circle
from touchgoal.control.calibration.press_set import PressSet
from touchgoal.runtime.errors import UserError, install_extra

PIXEL_PITCH = 0.059e-3
"""m per pixel of the presses here: half of the wheel's 640x480 at 0.0295 mm (its params.json)."""

_BALLS = {"gelsight": 2.0e-3, "gelsight_mini": np.nan}  # m; the Mini's radius is not recorded
_DOWNSAMPLING = 2  # taxim's pixels to one of ours
_FULL_SHAPE = 480, 640
_UNTOUCHED_HEIGHT = 5.0  # mm above the gel


def real_presses(sensor: str) -> PressSet:
    """Return the wheel's 48 presses of `gelsight` or 24 of `gelsight_mini`, at 320x240.

    UserError: the wheel is not installed.
    """
    spec = importlib.util.find_spec("taxim")
    if spec is None or spec.origin is None:
        raise UserError(f"the real presses ship with a peer: {install_extra('peers')}")
    pack = np.load(Path(spec.origin).parent / "calib" / sensor / "dataPack.npz", allow_pickle=True)
    images = np.stack([_downsample(image) for image in pack["imgs"]])
    # the centre of pixel 0 is 0 at both sizes; pixels 0 and 1 become one
    centres = (pack["touch_center"].astype(float) + 0.5) / _DOWNSAMPLING - 0.5
    circles = np.column_stack([centres, pack["touch_radius"] / _DOWNSAMPLING])
    files = tuple(f"press_{i:02d}.png" for i in range(len(images)))
    balls = np.full(len(images), _BALLS[sensor])
    return PressSet(_downsample(pack["f0"]), images, circles, balls, files)


def has_taxim() -> bool:
    """Return whether the wheel is installed."""
    return importlib.util.find_spec("taxim") is not None


def has_jax() -> bool:
    """Return whether taxim can render: its other back end needs torchvision."""
    return importlib.util.find_spec("jax") is not None


class TaximRenderer:
    """Taxim's images of a ball, RGB counts at 320x240, with shadows.

    Its untouched image is off the real one by 4 (GelSight) to 18 counts (Mini).
    """

    def __init__(self, sensor: str) -> None:
        taxim: Any = importlib.import_module("taxim")
        calibration = getattr(taxim, f"CALIB_{sensor.upper()}")
        self._simulator = taxim.Taxim(calib_folder=calibration, backend="jax")
        self.untouched = self._image(np.full(_FULL_SHAPE, _UNTOUCHED_HEIGHT, np.float32))

    def render(
        self, circle: Circle, ball_radius: float, contact_share: float
    ) -> Float32[np.ndarray, "h w 3"]:
        """Render one press: circle of contact (px), radius (m).

        `contact_share` is the share of the deepest overlap at the circle: 0 where the ball cuts the
        flat gel, 0.4 where taxim's gel model comes loose from it.
        """
        return self._image(_ball_height(circle, ball_radius, contact_share))

    def _image(self, height: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h2 w2 3"]:
        full = 255 * np.asarray(self._simulator.render(height, with_shadow=True))
        rows, columns = _FULL_SHAPE
        size = columns // _DOWNSAMPLING, rows // _DOWNSAMPLING
        return np.asarray(cv2.resize(full, size, interpolation=cv2.INTER_AREA), np.float32)


def _ball_height(
    circle: Circle, ball_radius: float, contact_share: float
) -> Float32[np.ndarray, "h w"]:
    """Return the height (mm) of a ball over taxim's flat gel, negative where pressed in."""
    x, y = (circle[:2] + 0.5) * _DOWNSAMPLING - 0.5
    contact = min(circle[2] * PIXEL_PITCH, 0.98 * ball_radius)
    rows, columns = np.indices(_FULL_SHAPE)
    square = ((columns - x) ** 2 + (rows - y) ** 2) * (PIXEL_PITCH / _DOWNSAMPLING) ** 2
    depth = (ball_radius - np.sqrt(ball_radius**2 - contact**2)) / (1 - contact_share)
    height = ball_radius - np.sqrt(np.maximum(ball_radius**2 - square, 0)) - depth
    return np.where(square < ball_radius**2, height * 1e3, _UNTOUCHED_HEIGHT).astype(np.float32)


def _downsample(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Halve the size; the wheel stores BGR."""
    size = image.shape[1] // _DOWNSAMPLING, image.shape[0] // _DOWNSAMPLING
    rgb = np.ascontiguousarray(image[..., ::-1])
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)

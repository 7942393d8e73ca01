"""Pictures of a calibration: presses side by side, and the lights."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.control.tactile.sensor_calibration import SensorCalibration

CONTRAST = 4  # of the difference column
_LIGHTS = {"R": (213, 94, 0), "G": (0, 158, 115), "B": (0, 114, 178)}  # Okabe and Ito
_GREY, _INK, _PAPER = (150, 150, 150), (40, 40, 40), 255


def side_by_side(
    measured: Sequence[UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w 3"]],
    simulated: Sequence[Float32[np.ndarray, "h w 3"]],
    pairs_a_row: int = 2,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw measured | simulated | difference times CONTRAST about grey, RGB, with a heading.

    Args:
        measured: RGB counts.
        simulated: RGB counts, as many.
        pairs_a_row: presses next to each other.
    """
    tiles = []
    for real, made in zip(measured, simulated, strict=True):
        picture = made.clip(0, 255)
        difference = (128 + CONTRAST * (real - picture)).clip(0, 255)
        tiles.append(np.hstack([real, picture, difference]).astype(np.uint8))
    tiles += [np.full_like(tiles[0], _PAPER)] * (-len(tiles) % pairs_a_row)
    rows = [np.hstack(tiles[i : i + pairs_a_row]) for i in range(0, len(tiles), pairs_a_row)]
    heading = _heading(tiles[0].shape[1] // 3, pairs_a_row)
    return np.vstack([heading, *rows])


def light_compass(calibration: SensorCalibration, size: int = 320) -> UInt8[np.ndarray, "s s 3"]:
    """Draw where in the image the lights stand, by channel: x to the right, y down.

    A line's length is the channel's response to slope in the middle of the image, relative to the
    strongest.
    """
    picture = np.full((size, size, 3), _PAPER, np.uint8)
    centre, reach = size // 2, 0.36 * size
    cv2.circle(picture, (centre, centre), round(reach), _GREY, 1, cv2.LINE_AA)
    for text, dx, dy in (("0", 1, 0), ("90", 0, 1), ("180", -1, 0), ("-90", 0, -1)):
        _write(picture, text, centre + dx * 1.18 * reach, centre + dy * 1.18 * reach, _GREY)
    strength = np.linalg.norm(calibration.response[:, :2, 0], axis=1)
    lengths = (reach * strength / strength.max()).tolist()
    for (name, colour), azimuth, length in zip(
        _LIGHTS.items(), calibration.light_azimuths, lengths, strict=True
    ):
        dx, dy = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        tip = round(centre + length * dx), round(centre + length * dy)
        cv2.arrowedLine(picture, (centre, centre), tip, colour, 3, cv2.LINE_AA, tipLength=0.08)
        beside = centre + 0.62 * length * dx - 28 * dy, centre + 0.62 * length * dy + 28 * dx
        _write(picture, f"{name} {azimuth:.0f}", *beside, colour)
    return picture


def _heading(width: int, repeats: int) -> UInt8[np.ndarray, "h w 3"]:
    heading = np.full((24, 3 * width * repeats, 3), _PAPER, np.uint8)
    for i in range(3 * repeats):
        text = ("measured", "simulated", f"difference x{CONTRAST}")[i % 3]
        _write(heading, text, (i + 0.5) * width, 12, _INK)
    return heading


def _write(
    picture: UInt8[np.ndarray, "h w 3"], text: str, x: float, y: float, colour: tuple[int, int, int]
) -> None:
    """Write text centred at (x, y)."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    at = round(x - width / 2), round(y + height / 2)
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)

"""The light of a sensor changes from press to press: brought back to the background's."""

import numpy as np
from jaxtyping import Float, UInt8

_FAR = 3.0  # contact radii from which on a press leaves the gel as it was
_ROUNDS = 4
_TOLERANCE = 1.0  # counts


def without_drift(
    image: UInt8[np.ndarray, "h w 3"],
    background: UInt8[np.ndarray, "h w 3"],
    circle: Float[np.ndarray, "3"],
) -> UInt8[np.ndarray, "h w 3"]:
    """A press as it would look in the background's light.

    Gain and offset of each channel, by a robust line through the pixels far from the contact.

    Args:
        image: RGB picture of a press.
        background: the sensor untouched.
        circle: of the contact, px.
    """
    x, y, radius = circle
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    far = (columns - x) ** 2 + (rows - y) ** 2 > (_FAR * radius) ** 2
    if far.mean() < 0.1:
        return image
    steady = np.empty_like(image)
    for channel in range(3):
        gain, offset = _line(background[far, channel], image[far, channel])
        steady[..., channel] = np.rint((image[..., channel] - offset) / gain).clip(0, 255)
    return steady


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain and offset with the least absolute error."""
    terms = np.stack([x, np.ones(len(x))], 1).astype(np.float64)
    weight, solved = np.ones(len(x)), np.array([1.0, 0.0])
    for _ in range(_ROUNDS):
        weighted = terms * weight[:, None]
        solved = np.linalg.solve(terms.T @ weighted + 1e-6 * np.eye(2), weighted.T @ y)
        weight = 1 / np.maximum(np.abs(y - terms @ solved), _TOLERANCE)
    return float(solved[0]), float(solved[1])

"""When a fingertip touches something, from its pictures alone."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

# Pictures are averaged over _CELL x _CELL pixels and then blurred. Measured on 320 x 240 frames:
# pixel noise of 1 count gives a strength of at most 0.35 counts, whatever the light's drift, and a
# bump of shading that falls off within 15 pixels (sigma 7.5) keeps six tenths of its height.
_CELL = 4
_BLUR_CELLS = 1.5


def contact_strength(
    frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, " n"]:
    """How much the strongest spot of each frame differs from the untouched gel, in counts.

    The difference to the background is blurred; in each channel, what brighter or dimmer light
    explains (the least-squares offset and gain of the background) is taken out; the largest norm
    over the three channels of what remains is returned.

    Args:
        frames: RGB pictures of one fingertip sensor.
        background: the same sensor untouched.
    """
    reference = _blurred(background)
    mean = reference.mean((0, 1))
    varying = reference - mean
    energy = (varying**2).sum((0, 1)) + 1e-6
    strength = np.empty(len(frames), np.float32)
    for i, frame in enumerate(frames):
        difference = _blurred(frame) - reference
        difference -= difference.mean((0, 1))
        difference -= (difference * varying).sum((0, 1)) / energy * varying
        strength[i] = np.sqrt((difference**2).sum(2).max())
    return strength


def detect_contact(
    frames: UInt8[np.ndarray, "n h w 3"],
    background: UInt8[np.ndarray, "h w 3"],
    threshold: float | int = 2.0,
) -> Bool[np.ndarray, " n"]:
    """Whether the sensor touches something, frame by frame.

    Contact begins when `contact_strength` exceeds the threshold and ends when it falls below half
    of it, so that strength about the threshold does not make contact flicker.

    Args:
        frames: consecutive RGB pictures of one fingertip sensor.
        background: the same sensor untouched, such as the median of the first frames.
        threshold: counts, in which pixel noise of 1 count has a strength of about 0.3.
    """
    touching = False
    contact = np.zeros(len(frames), bool)
    for i, strength in enumerate(contact_strength(frames, background)):
        touching = bool(strength > (threshold / 2 if touching else threshold))
        contact[i] = touching
    return contact


def _blurred(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "H W 3"]:
    height, width, _ = image.shape
    size = max(width // _CELL, 1), max(height // _CELL, 1)
    small = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), _BLUR_CELLS)

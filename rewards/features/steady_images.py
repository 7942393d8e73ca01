"""Camera images made alike in sharpness and grain before an ImageNet network sees them.

Taught by photographs, it reads flat, rendered surfaces by their faintest texture: a camera's noise of 1.5
counts, a JPEG or another size of the image move its features as far as a failure is from a success.
"""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from touchgoal.encoders.towers.towers import IMAGENET_SIDE

STEADY = "offline, steady images"  # in an `EmbeddingSource`: the offline towers, of such images
_SHARP = 128  # px, the shorter side to which an image is shrunk first: finer detail is lost
_SMOOTHING, _GRAIN = 1.0, 4.0  # standard deviations: px of the shrunk image; counts of 255


def steady_images(images: UInt8[np.ndarray, "n h w 3"]) -> UInt8[np.ndarray, "n y x 3"]:
    """Return images as large as the network takes them, smoothed, with one and the same grain."""
    h, w = images.shape[1:3]
    small, size = ((s * w // min(h, w), s * h // min(h, w)) for s in (_SHARP, IMAGENET_SIDE))
    steady, grain = np.empty((len(images), *size[::-1], 3), np.uint8), _grain(*size)
    for i, image in enumerate(images):
        sharp = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
        smooth = cv2.GaussianBlur(sharp, (0, 0), _SMOOTHING)
        steady[i] = np.clip(cv2.resize(smooth, size, interpolation=cv2.INTER_CUBIC) + grain, 0, 255)
    return steady


@cache
def _grain(width: int, height: int) -> Float32[np.ndarray, "y x 3"]:
    return np.random.default_rng(0).normal(0, _GRAIN, (height, width, 3)).astype(np.float32)

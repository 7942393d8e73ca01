"""A policy's own network for the pictures of both fingertips, trained along with it."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from touchgoal.encoders.backbones.vit import ViT, ViTConfig

_ZERO = 128  # grey level of an unchanged touch
_SCALE = 16.0  # grey levels that make 1.0 of a touch, as in `encoders/preprocess.py`


@dataclass(frozen=True)
class EndToEndConfig:
    """An encoder for both fingertips at the latest tick: a ViT, which reads textures.

    Attributes:
        size: rows and columns of the pictures it takes; twice as many of either learn nine times
            slower.
        width: of the embedding of one picture.
    """

    size: tuple[int, int] = (60, 80)
    width: int = 64


def difference_images(
    frames: UInt8[np.ndarray, "n H W 3"], first: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "n h w 3"]:
    """The change of a fingertip's pictures since the untouched first one, at the encoder's size."""
    h, w = size
    change = frames - first.astype(np.int16) + _ZERO
    frames = np.clip(change, 0, 255).astype(np.uint8)
    return np.stack([cv2.resize(f, (w, h), interpolation=cv2.INTER_AREA) for f in frames])


class EndToEndEncoder(nn.Module):
    """Pictures of both fingertips to one vector, through one network."""

    def __init__(self, config: EndToEndConfig) -> None:
        """Randomly initialised."""
        super().__init__()
        vit = ViTConfig(image_size=config.size, width=128, depth=4, heads=4)
        self.vit, self.say = ViT(vit), nn.Linear(vit.width, config.width)

    def forward(self, pictures: UInt8[Tensor, "b k h w 3"]) -> Float[Tensor, "b e"]:
        """The embedding of the latest tick, a picture of each of `features.TACTILE`."""
        count = pictures.shape[1]
        images = (pictures.flatten(0, 1).permute(0, 3, 1, 2).float() - _ZERO) / _SCALE
        return self.say(self.vit.features(images)).unflatten(0, (-1, count)).flatten(1)

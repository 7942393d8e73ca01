"""Touch encoder that is trained jointly with the policy."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.encoders.backbones.vit import ViT, ViTConfig

_ZERO = 128  # grey level of an unchanged pixel
_SCALE = 16.0  # grey levels per 1.0 of the input, as in `encoders/preprocess.py`


@dataclass(frozen=True)
class EndToEndConfig:
    """Size of a ViT for both tactile images of the latest tick."""

    size: tuple[int, int] = (60, 80)  # rows, columns; twice either trains nine times slower
    width: int = 64  # of the embedding of one image


def difference_images(
    frames: UInt8[np.ndarray, "n H W 3"], first: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "n h w 3"]:
    """Return the change of tactile images since the untouched first one, at the encoder's size."""
    h, w = size
    small = []
    for frame in frames:
        change = np.rint(remove_gain(frame, first)) - first + _ZERO
        image = np.clip(change, 0, 255).astype(np.uint8)
        small.append(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA))
    return np.stack(small)


class EndToEndEncoder(nn.Module):
    """Network from both tactile images to one vector; both sides share its weights."""

    def __init__(self, config: EndToEndConfig) -> None:
        super().__init__()
        vit = ViTConfig(image_size=config.size, width=128, depth=4, heads=4)
        self.vit, self.projection = ViT(vit), nn.Linear(vit.width, config.width)

    def forward(self, frames: UInt8[Tensor, "b k h w 3"]) -> Float[Tensor, "b e"]:
        """Return the embedding of a tick with an image of each of `features.TACTILE`."""
        count = frames.shape[1]
        images = (frames.flatten(0, 1).permute(0, 3, 1, 2).float() - _ZERO) / _SCALE
        return self.projection(self.vit.features(images)).unflatten(0, (-1, count)).flatten(1)

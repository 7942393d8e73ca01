"""Eyes: networks of a policy's own for pictures, trained along with it."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from touchgoal.control import vocabulary as v
from touchgoal.control.errors import UserError
from touchgoal.encoders.vit import ViT, ViTConfig

_ZERO = 128  # grey level of an unchanged touch
_SCALE = 16.0  # grey levels that make 1.0 of a touch, as in `encoders/preprocess.py`


@dataclass(frozen=True)
class EyeConfig:
    """An eye for the pictures of some columns, at the latest tick.

    Attributes:
        keys: columns of pictures; each has a network of its own, both fingertips share one.
        size: rows and columns of the pictures looked at.
        network: "cnn" finds points (Finn et al. 2016; Levine et al. 2016), which is where things
            are; "vit" reads textures, as touch encoders do.
        width: of what an eye says of one picture.
    """

    keys: tuple[str, ...]
    size: tuple[int, int] = (96, 96)
    network: Literal["cnn", "vit"] = "cnn"
    width: int = 64

    def __post_init__(self) -> None:
        """Raises UserError for columns that are no pictures."""
        if wrong := set(self.keys) - {*v.CAMERAS, *v.TACTILE}:
            raise UserError(f"{sorted(wrong)[0]!r} is no column of pictures: look at others")


def shrink(
    frames: UInt8[np.ndarray, "n H W 3"],
    key: str,
    first: UInt8[np.ndarray, "H W 3"],
    size: tuple[int, int],
) -> UInt8[np.ndarray, "n h w 3"]:
    """Pictures at an eye's size; of a fingertip its change since the untouched first frame."""
    h, w = size
    if key in v.TACTILE:
        untouched = first.astype(np.int16)
        frames = np.clip(frames - untouched + _ZERO, 0, 255).astype(np.uint8)
    return np.stack([cv2.resize(f, (w, h), interpolation=cv2.INTER_AREA) for f in frames])


class Eye(nn.Module):
    """Pictures of all keys to one vector."""

    def __init__(self, config: EyeConfig) -> None:
        """Randomly initialised."""
        super().__init__()
        self.config = config
        names = dict.fromkeys(_network_of(key) for key in config.keys)
        self.networks = nn.ModuleDict({name: _network(config) for name in names})

    def forward(self, pictures: UInt8[Tensor, "b k h w 3"]) -> Float[Tensor, "b e"]:
        """What the eye says of the latest tick, k pictures of `config.keys` each."""
        said = []
        for i, key in enumerate(self.config.keys):
            picture = pictures[:, i].permute(0, 3, 1, 2).float()
            scale = _SCALE if key in v.TACTILE else 128.0
            said.append(self.networks[_network_of(key)]((picture - _ZERO) / scale))
        return torch.cat(said, 1)


def _network_of(key: str) -> str:
    return "touch" if key in v.TACTILE else key.rsplit(".", 1)[-1]


def _network(config: EyeConfig) -> nn.Module:
    if config.network == "vit":
        vit = ViTConfig(image_size=config.size, width=128, depth=4, heads=4)
        return nn.Sequential(_Pooled(vit), nn.Linear(vit.width, config.width))
    channels = 16, 32, 48
    layers: list[nn.Module] = []
    for before, after, stride in zip((3, *channels), channels, (2, 2, 1), strict=False):
        layers += [
            nn.Conv2d(before, after, 5 if before == 3 else 3, stride, 2 if before == 3 else 1),
            nn.GroupNorm(8, after),
            nn.ReLU(),
        ]
    points = _Points(channels[-1])
    return nn.Sequential(*layers, points, nn.Linear(2 * channels[-1], config.width), nn.ReLU())


class _Pooled(nn.Module):
    def __init__(self, config: ViTConfig) -> None:
        super().__init__()
        self.vit = ViT(config)

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        return self.vit.features(images)


class _Points(nn.Module):
    """Spatial softmax: where in the picture each channel is active, in [-1, 1]."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.sharpness = nn.Parameter(torch.ones(channels, 1))

    def forward(self, maps: Float[Tensor, "b c h w"]) -> Float[Tensor, "b p"]:
        h, w = maps.shape[2:]
        share = F.softmax(self.sharpness * maps.flatten(2), 2).view(maps.shape)
        x = (share.sum(2) * torch.linspace(-1, 1, w, device=maps.device)).sum(2)
        y = (share.sum(3) * torch.linspace(-1, 1, h, device=maps.device)).sum(2)
        return torch.cat([x, y], 1)

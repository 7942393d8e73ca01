"""Frozen image encoder for a policy's cameras: feature maps, from which keypoints are learned."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Float16
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.encoders.compiled_network import CompiledNetwork
from touchgoal.encoders.towers.efficientnet import load_efficientnet_lite0
from touchgoal.encoders.towers.towers import imagenet_pixels
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.perception.pose_estimator import keypoints
from touchgoal.runtime.errors import UserError

MAP_CHANNELS = 40  # of `EfficientNetLite0.fine_map`
_SHARPNESS = 10.0  # of the softmax; all keypoints begin in the middle and soon leave it
_BATCH = 32  # images


@dataclass(frozen=True)
class ImageInputConfig:
    """Cameras that a policy reads at every plan, and the network that finds keypoints in their maps."""

    cameras: tuple[str, ...]  # columns such as observation.images.front
    size: tuple[int, int]  # rows and columns of their images, px
    hidden: int = 32  # channels of the convolutions that find the keypoints
    keypoints: int = 32  # of each image

    @property
    def on_hand(self) -> tuple[bool, ...]:
        """Whether each camera moves with the hand, by its name."""
        return tuple("wrist" in key or "hand" in key for key in self.cameras)


class ImageEmbedder:
    """Feature maps of camera images at stride 8 by the offline image tower (EfficientNet-Lite0).

    Attributes:
        name: identifies the maps.
        shape: of one tick's maps: cameras, channels, rows, columns.
    """

    def __init__(self, config: ImageInputConfig) -> None:
        """Get ready; UserError if the image tower's wheel is missing."""
        self.config = config
        cameras = "-".join(key.removeprefix(ft.IMAGE_PREFIX) for key in config.cameras)
        self.name = f"efficientnet-lite0-stride8/{cameras}"
        blank = np.zeros((1, *config.size, 3), np.uint8)
        self.shape = (len(config.cameras), *self._maps(blank).shape[1:])

    def embed(self, episodes: EpisodeSet, i: int) -> Float16[np.ndarray, "t k c y x"]:
        """Embed all ticks of an episode; UserError if its images have another size."""
        frames = episodes.read(i, self.config.cameras).frames
        return np.stack([self._maps(frames[key]) for key in self.config.cameras], 1)

    def embed_tick(self, observation: Mapping[str, np.ndarray]) -> Float16[np.ndarray, "k c y x"]:
        """Embed one tick, with the same result as `embed`."""
        return np.concatenate([self._maps(observation[key][None]) for key in self.config.cameras])

    def _maps(self, images: np.ndarray) -> Float16[np.ndarray, "n c y x"]:
        if images.shape[1:3] != self.config.size:
            given, wanted = (f"{h} x {w}" for h, w in (images.shape[1:3], self.config.size))
            raise UserError(
                f"camera images are {given}, the policy reads {wanted}: make the environment with "
                "load_policy(...).env_config(), or set camera_size"
            )
        batches = [images[i : i + _BATCH] for i in range(0, len(images), _BATCH)]
        return np.concatenate([_network()(imagenet_pixels(b))[0].half().numpy() for b in batches])


class _FineMap(nn.Module):
    """The image tower up to stride 8."""

    def __init__(self) -> None:
        super().__init__()
        self.tower = load_efficientnet_lite0().requires_grad_(False)

    def forward(self, x: Float[Tensor, "n 3 h w"]) -> tuple[Float[Tensor, "n c y x"]]:
        return (self.tower.fine_map(x),)


@cache
def _network() -> CompiledNetwork:
    return CompiledNetwork(_FineMap().eval())


class ImageReadout(nn.Module):
    """Network from the feature maps of one camera to the positions of keypoints, without features.

    With features it would recognise each recorded scene.
    """

    def __init__(self, config: ImageInputConfig) -> None:
        super().__init__()
        self.config = config
        self.mean = nn.Buffer(torch.zeros(MAP_CHANNELS, 1, 1))
        self.std = nn.Buffer(torch.ones(MAP_CHANNELS, 1, 1))
        self.layers = nn.Sequential(
            nn.Conv2d(MAP_CHANNELS, config.hidden, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(config.hidden, config.hidden, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(config.hidden, config.keypoints, 1),
        )

    def fit(self, maps: Float16[Tensor, "n c y x"]) -> None:
        """Fit mean and standard deviation of each channel to training data."""
        sample = maps[:: max(1, len(maps) // 512)].float()
        self.mean.copy_(sample.mean((0, 2, 3))[:, None, None])
        self.std.copy_(sample.std((0, 2, 3)).clamp(min=1e-3)[:, None, None])

    def forward(self, maps: Float[Tensor, "b c y x"]) -> Float[Tensor, "b p"]:
        """Return the position of each keypoint."""
        return keypoints(_SHARPNESS * self.layers((maps - self.mean) / self.std), maps[:, :0])

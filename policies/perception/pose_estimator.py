"""Pose estimator: a network from an episode's first camera images to object and goal poses."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.policies.actions import Normalizer
from touchgoal.policies.config import PoseEstimatorConfig
from touchgoal.policies.perception.keypoints import keypoints

_START = ft.FEATURES[ft.TRUTH_START].shape[0]
_TCP = ft.FEATURES[ft.TCP_POSE].shape[0]


class PoseEstimator(nn.Module):
    """Network from the first camera images to `features.TRUTH_START`."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        """Initialise at random; fit the normalizers before training."""
        super().__init__()
        self.config = config
        self.networks = nn.ModuleList(_SpatialSoftmax(config) for _ in config.crops)
        width = _TCP + config.keypoints * (2 + config.keypoint_features) * len(config.crops)
        self.tcp_normalizer, self.start_normalizer = Normalizer((_TCP,)), Normalizer((_START,))
        self.head = nn.Sequential(
            nn.Linear(width, config.width), nn.Mish(),
            nn.Linear(config.width, config.width), nn.Mish(),
            nn.Linear(config.width, _START),
        )  # fmt: skip

    def forward(
        self, pictures: dict[str, UInt8[Tensor, "b h w 3"]], tcp: Float[Tensor, "b 7"]
    ) -> Float[Tensor, "b 7"]:
        """Return the estimate: m, base frame."""
        return self.start_normalizer.inverse(self.scaled(pictures, tcp))

    def scaled(
        self, pictures: dict[str, UInt8[Tensor, "b h w 3"]], tcp: Float[Tensor, "b 7"]
    ) -> Float[Tensor, "b 7"]:
        """Return the estimate, normalised to variance 1."""
        parts = [self.tcp_normalizer(tcp)]
        for (key, (top, bottom, left, right)), network in zip(
            self.config.crops, self.networks, strict=True
        ):
            crop = pictures[key][:, top:bottom, left:right].permute(0, 3, 1, 2)
            parts.append(network(crop.float() / 64 - 2))
        return self.head(torch.cat(parts, 1))


class _Surroundings(nn.Module):
    """Dilated convolution, added to each cell."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.around = nn.Conv2d(width, width, 3, 1, dilation, dilation)
        self.mix = nn.Conv2d(width, width, 1)

    def forward(self, maps: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return maps + self.mix(F.relu(self.around(F.relu(maps))))


class _SpatialSoftmax(nn.Module):
    """Keypoints of an image: the place of each, in [-1, 1], and its features."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        super().__init__()
        width = config.channels
        self.patches = nn.Conv2d(3, width, 8, 4, 2)
        self.surroundings = nn.Sequential(*(_Surroundings(width, d) for d in config.dilations))
        self.attention = nn.Conv2d(width, config.keypoints, 1)
        self.features = nn.Conv2d(width, config.keypoint_features, 1)

    def forward(self, pictures: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b p"]:
        maps = F.relu(self.surroundings(self.patches(pictures)))
        return keypoints(self.attention(maps), self.features(maps))

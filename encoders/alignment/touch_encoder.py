"""The touch encoder: a ViT over touch, and heads that meet it in the space of the frozen towers."""

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor, nn

from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder
from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.towers.towers import Towers


@dataclass(frozen=True)
class TouchEncoderConfig:
    """What an encoder is and what it was trained with.

    Attributes:
        vit: The touch backbone.
        embedding_dim: Width of the shared space.
        sensor: Name of the fingertip sensor.
        preprocessor: `TactilePreprocessor.id` in use at training.
        towers: `Towers.name` of the frozen towers.
        image_dim: Width of their image embeddings.
        text_dim: Width of their text embeddings.
        pretrained_together: The towers' own space is the shared space.
    """

    vit: ViTConfig
    embedding_dim: int
    sensor: str
    preprocessor: str
    towers: str
    image_dim: int
    text_dim: int
    pretrained_together: bool

    @classmethod
    def for_towers(
        cls, vit: ViTConfig, towers: Towers, sensor: str, embedding_dim: int
    ) -> "TouchEncoderConfig":
        """The configuration that fits these towers.

        Args:
            vit: The touch backbone.
            towers: The frozen towers.
            sensor: Name of the fingertip sensor.
            embedding_dim: Width of the shared space; towers pretrained together bring their own.

        Raises:
            UserError: Unknown sensor.
        """
        preprocess = preprocessor_for(sensor)
        return cls(
            vit=replace(vit, image_size=preprocess.size),
            embedding_dim=towers.image_dim if towers.pretrained_together else embedding_dim,
            sensor=sensor,
            preprocessor=preprocess.id,
            towers=towers.name,
            image_dim=towers.image_dim,
            text_dim=towers.text_dim,
            pretrained_together=towers.pretrained_together,
        )


class TouchEncoder(BaseTouchEncoder):
    """Touch, images and texts as unit vectors of one space.

    As in ImageBind, the touch head is a LayerNorm (the backbone's last layer), pooling and a bias-free
    linear layer. When the towers were not pretrained together, images and texts have bias-free
    linear heads too; otherwise their embeddings are only normalised.
    """

    def __init__(self, config: TouchEncoderConfig) -> None:
        """Builds a randomly initialised encoder; UserError for an unknown sensor."""
        super().__init__(preprocessor_for(config.sensor), config.embedding_dim)
        self.config = config
        self.backbone = ViT(config.vit)
        d = config.embedding_dim
        self.touch_head = nn.Linear(config.vit.width, d, bias=False)
        together = config.pretrained_together
        self.image_head = None if together else nn.Linear(config.image_dim, d, bias=False)
        self.text_head = None if together else nn.Linear(config.text_dim, d, bias=False)

    @property
    def towers(self) -> str:
        """See BaseTouchEncoder."""
        return self.config.towers

    def embed_touch(
        self, touch: Float[Tensor, "n 3 h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """See BaseTouchEncoder."""
        return F.normalize(self.touch_head(self.backbone.features(touch, ids_keep)), dim=1)

    def project_image(self, embeddings: Float[Tensor, "n k"]) -> Float[Tensor, "n d"]:
        """Brings the image tower's embeddings into the shared space."""
        if self.image_head is not None:
            embeddings = self.image_head(embeddings)
        return F.normalize(embeddings, dim=1)

    def project_text(self, embeddings: Float[Tensor, "n k"]) -> Float[Tensor, "n d"]:
        """Brings the text tower's embeddings into the shared space."""
        if self.text_head is not None:
            embeddings = self.text_head(embeddings)
        return F.normalize(embeddings, dim=1)

    @torch.no_grad()
    def embed_image_goal(
        self, images: UInt8[np.ndarray, "n h w 3"], towers: Towers
    ) -> Float32[np.ndarray, "n d"]:
        """Camera pictures in the shared space, to be compared with `embed_frames`.

        Raises:
            UserError: The encoder was trained with other towers.
        """
        self.check_towers(towers)
        return self.project_image(towers.embed_images(images).to(self.device)).cpu().numpy()

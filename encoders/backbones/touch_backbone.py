"""A touch backbone: a ViT over touch alone, as self-supervision leaves it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor, nn

from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.encoders.preprocess import TactilePreprocessor, preprocessor_for

BATCH = 64  # frames at once


@dataclass(frozen=True)
class TouchBackboneConfig:
    """What a backbone is and what it was trained with.

    Attributes:
        vit: Its size.
        sensor: Name of the fingertip sensor.
        preprocessor: `TactilePreprocessor.id` in use at training.
    """

    vit: ViTConfig
    sensor: str
    preprocessor: str

    @classmethod
    def for_sensor(cls, vit: ViTConfig, sensor: str) -> "TouchBackboneConfig":
        """The configuration for a sensor; UserError for an unknown one."""
        return cls(vit, sensor, preprocessor_for(sensor).id)

    @property
    def embedding_dim(self) -> int:
        """Width of an embedding."""
        return self.vit.width


class BaseTouchEncoder(nn.Module):
    """What embeds touch, of any kind: subclasses say how preprocessed frames become embeddings."""

    def __init__(self, sensor: str, embedding_dim: int) -> None:
        """For a sensor; UserError for an unknown one."""
        super().__init__()
        self.preprocess: TactilePreprocessor = preprocessor_for(sensor)
        self._width = embedding_dim

    def embed_touch(
        self, touch: Float[Tensor, "n 3 h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """Embeds preprocessed frames, of which only the patches in `ids_keep` are seen if given."""
        raise NotImplementedError

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    @torch.no_grad()
    def embed_frames(
        self, frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
    ) -> Float32[np.ndarray, "n d"]:
        """Embeds raw frames of one sensor, given the same sensor untouched.

        Raises:
            UserError: The frames are not of this encoder's sensor.
        """
        rows = np.empty((len(frames), self._width), np.float32)
        for i in range(0, len(frames), BATCH):
            touch = torch.from_numpy(self.preprocess(frames[i : i + BATCH], background))
            rows[i : i + BATCH] = self.embed_touch(touch.to(self.device)).cpu().numpy()
        return rows


class TouchBackbone(BaseTouchEncoder):
    """Touch as the mean of a ViT's tokens."""

    def __init__(self, config: TouchBackboneConfig) -> None:
        """Builds a randomly initialised backbone; UserError for an unknown sensor."""
        super().__init__(config.sensor, config.embedding_dim)
        self.config = config
        self.vit = ViT(config.vit)

    def embed_touch(
        self, touch: Float[Tensor, "n 3 h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """See BaseTouchEncoder."""
        return self.vit.features(touch, ids_keep)

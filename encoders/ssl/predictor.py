"""Prediction of what a teacher makes of the patches that the backbone does not see (JEPA: LeCun 2022)."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.backbones.vit import Block, ViTConfig, patch_grid, sinusoidal_positions
from touchgoal.encoders.ssl.config import PredictorConfig
from touchgoal.encoders.ssl.self_distillation import SelfDistillation


class Predictor(nn.Module):
    """A narrow transformer: from the tokens of seen patches to those of others, told by their places."""

    places: Float[Tensor, "n w"]

    def __init__(self, vit: ViTConfig, config: PredictorConfig) -> None:
        """Randomly initialised, for a backbone."""
        super().__init__()
        width = config.predictor_width
        self.embed = nn.Linear(vit.width, width)
        self.mask_token = nn.Parameter(0.02 * torch.randn(width))
        self.blocks = nn.ModuleList(
            Block(width, config.predictor_heads, 4.0, vit.norm_epsilon)
            for _ in range(config.predictor_depth)
        )
        self.norm = nn.LayerNorm(width, vit.norm_epsilon)
        self.out = nn.Linear(width, vit.width)
        times = vit.frames // vit.tubelet if vit.tubelet > 1 else None
        codes = sinusoidal_positions(*patch_grid(vit), width, times)
        self.register_buffer("places", codes, persistent=False)

    def forward(
        self,
        seen: Float[Tensor, "b k d"],
        seen_ids: Int[Tensor, "b k"],
        wanted_ids: Int[Tensor, "b j"],
    ) -> Float[Tensor, "b j d"]:
        """Tokens of the wanted patches."""
        x = self.embed(seen)
        asked = (self.mask_token + self.places[wanted_ids]).to(x)
        x = torch.cat([x + self.places[seen_ids].to(x), asked], 1)
        for block in self.blocks:
            x = block(x)
        return self.out(self.norm(x[:, seen.shape[1] :]))


class JointEmbeddingPrediction(SelfDistillation):
    """A backbone that sees parts, a predictor, and a teacher that sees all; subclasses draw the parts."""

    def __init__(self, config: PredictorConfig, backbone: TouchBackbone, steps: int) -> None:
        """Randomly initialised; see `SelfDistillation`."""
        super().__init__(config, backbone, steps)
        self.config = config
        self.predictor = Predictor(backbone.config.vit, config)

    @property
    def least_seen(self) -> int:
        """Patches that are always left to see in each frame: an eighth."""
        rows, columns = patch_grid(self.backbone.config.vit)
        return max(rows * columns // 8, 1)

    @torch.no_grad()
    def targets(self, images: Float[Tensor, "b c *t h w"]) -> Float[Tensor, "b n d"]:
        """The teacher's tokens of everything, each brought to mean 0 and variance 1."""
        tokens = self.teacher.vit(images).float()
        return F.layer_norm(tokens, tokens.shape[2:])

    def predict(
        self,
        patches: Float[Tensor, "b n d"],
        seen_ids: Int[Tensor, "b k"],
        wanted_ids: Int[Tensor, "b m j"],
    ) -> Float[Tensor, "b m j d"]:
        """Tokens of m sets of patches, each predicted for itself.

        Args:
            patches: Embedded patches of everything, of which only those in `seen_ids` are looked at.
            seen_ids: Patches that the backbone sees.
            wanted_ids: Patches asked for.
        """
        tokens = self.backbone.vit.encode(patches, seen_ids)
        tokens = tokens[:, self.backbone.config.vit.registers :]
        sets = wanted_ids.shape[1]
        tokens, places = (x.repeat_interleave(sets, 0) for x in (tokens, seen_ids))
        predicted = self.predictor(tokens, places, wanted_ids.flatten(0, 1))
        return predicted.unflatten(0, wanted_ids.shape[:2]).float()


def take(tokens: Float[Tensor, "b n d"], ids: Int[Tensor, "b m j"]) -> Float[Tensor, "b m j d"]:
    """The tokens of sets of patches."""
    index = ids.flatten(1)[:, :, None].expand(-1, -1, tokens.shape[2])
    return tokens.gather(1, index).unflatten(1, ids.shape[1:])

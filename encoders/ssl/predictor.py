"""Prediction of the teacher's tokens of hidden patches (JEPA: LeCun 2022)."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.backbones.vit import Block, ViTConfig, patch_grid, sinusoidal_positions
from touchgoal.encoders.ssl.config import PredictorConfig
from touchgoal.encoders.ssl.self_distillation import SelfDistillation

ASPECT = 0.75, 1.5  # least and greatest height over width of a target block, as in Assran et al.


class Predictor(nn.Module):
    """Narrow transformer from the tokens of given patches to those of others."""

    places: Float[Tensor, "n w"]

    def __init__(self, vit: ViTConfig, config: PredictorConfig) -> None:
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
        context: Float[Tensor, "b k d"],
        context_ids: Int[Tensor, "b k"],
        target_ids: Int[Tensor, "b j"],
    ) -> Float[Tensor, "b j d"]:
        """Return tokens of the target patches."""
        x = self.embed(context)
        asked = (self.mask_token + self.places[target_ids]).to(x)
        x = torch.cat([x + self.places[context_ids].to(x), asked], 1)
        for block in self.blocks:
            x = block(x)
        return self.out(self.norm(x[:, context.shape[1] :]))


class JointEmbeddingPrediction(SelfDistillation):
    """Backbone on part of the input, predictor, and teacher on all of it; subclasses draw parts."""

    def __init__(self, config: PredictorConfig, backbone: TouchBackbone, steps: int) -> None:
        super().__init__(config, backbone, steps)
        self.config = config
        self.predictor = Predictor(backbone.config.vit, config)

    @property
    def min_context(self) -> int:
        """Return the least number of patches left as input in each frame: an eighth."""
        rows, columns = patch_grid(self.backbone.config.vit)
        return max(rows * columns // 8, 1)

    @torch.no_grad()
    def targets(self, images: Float[Tensor, "b c *t h w"]) -> Float[Tensor, "b n d"]:
        """Return the teacher's tokens of all patches, each with mean 0 and variance 1."""
        tokens = self.teacher.vit(images).float()
        return F.layer_norm(tokens, tokens.shape[2:])

    def predict(
        self,
        patches: Float[Tensor, "b n d"],
        context_ids: Int[Tensor, "b k"],
        target_ids: Int[Tensor, "b m j"],
    ) -> Float[Tensor, "b m j d"]:
        """Return tokens of m sets of patches, each set predicted by itself."""
        tokens = self.backbone.vit.encode(patches, context_ids)
        tokens = tokens[:, self.backbone.config.vit.registers :]
        sets = target_ids.shape[1]
        tokens, places = (x.repeat_interleave(sets, 0) for x in (tokens, context_ids))
        predicted = self.predictor(tokens, places, target_ids.flatten(0, 1))
        return predicted.unflatten(0, target_ids.shape[:2]).float()


def gather_tokens(
    tokens: Float[Tensor, "b n d"], ids: Int[Tensor, "b m j"]
) -> Float[Tensor, "b m j d"]:
    """Return the tokens of sets of patches."""
    index = ids.flatten(1)[:, :, None].expand(-1, -1, tokens.shape[2])
    return tokens.gather(1, index).unflatten(1, ids.shape[1:])

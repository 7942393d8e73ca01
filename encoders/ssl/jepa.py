"""Joint-embedding prediction: I-JEPA and V-JEPA predict the teacher's tokens of hidden patches of touch.

Sources: LeCun 2022 (JEPA); Assran et al. 2023 (I-JEPA); Bardes et al. 2024 (V-JEPA); Sparsh.
"""

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.backbones.vit import Block, ViTConfig, patch_grid, sinusoidal_positions
from touchgoal.encoders.ssl import masks
from touchgoal.encoders.ssl.config import PredictorConfig, VJepaConfig
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


_SQUARE = 1.0, 1.0
# Share of the patches in the context block, from which the target blocks are cut out, and in each
# target block, as in Assran et al.
_CONTEXT_SCALE, _TARGET_SCALE = (0.85, 1.0), (0.15, 0.2)
_TARGET_BLOCKS = 4  # of each image


class IJepa(JointEmbeddingPrediction):
    """I-JEPA objective: predict each target block from a large block without the target blocks."""

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Any]:
        """Draw `context_ids` (count, k) and `target_ids` (count, blocks, j).

        k is that of the image with the fewest; of other images some are dropped.
        """
        grid = patch_grid(self.backbone.config.vit)
        size = masks.draw_size(grid, _CONTEXT_SCALE, _SQUARE, generator)
        context = masks.union_of_blocks(
            masks.draw_blocks(grid, size, count, 1, generator), grid[0] * grid[1]
        )
        size = masks.draw_size(grid, _TARGET_SCALE, ASPECT, generator)
        least = max(grid[0] * grid[1] // 8, 1)  # patches left as input
        target, left = masks.draw_targets(
            grid, size, count, _TARGET_BLOCKS, context, least, generator
        )
        return {"context_ids": masks.draw_equal_counts(left, generator), "target_ids": target}

    def forward(
        self, touch: Tensor, context_ids: Int[Tensor, "b k"], target_ids: Int[Tensor, "b m j"]
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the loss: smooth L1 distance of predicted and actual tokens, as released."""
        images = self.backbone.stack(touch.float())
        actual = gather_tokens(self.targets(images), target_ids)
        predicted = self.predict(self.backbone.vit.embed_patches(images), context_ids, target_ids)
        return {"loss": F.smooth_l1_loss(predicted, actual)}


_SMALL_SCALE, _LARGE_SCALE = 0.15, 0.7  # share of the patches in a hidden block of each mask
_LARGE_BLOCKS = 2  # hidden blocks of the second mask


class VJepa(JointEmbeddingPrediction):
    """V-JEPA objective: predict what each of two masks hides from what it leaves.

    A mask is the same in all frames, so that nothing hidden can be copied from an earlier frame.
    """

    config: VJepaConfig

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Any]:
        """Draw `context_ids` (count, k) and `target_ids` (count, 1, j) for each mask, time by time.

        k and j are those of the clip with the fewest; of other clips some are dropped.
        """
        config, vit = self.config, self.backbone.config.vit
        grid, times = patch_grid(vit), vit.frames // vit.tubelet
        everything = torch.ones(count, grid[0] * grid[1], dtype=torch.bool)
        drawn: dict[str, list[Tensor]] = {"context_ids": [], "target_ids": []}
        for scale, blocks in ((_SMALL_SCALE, config.small_blocks), (_LARGE_SCALE, _LARGE_BLOCKS)):
            size = masks.draw_size(grid, (scale, scale), ASPECT, generator)
            hidden, left = masks.draw_targets(grid, size, count, blocks, everything, 1, generator)
            target = masks.draw_equal_counts(
                masks.union_of_blocks(hidden, everything.shape[1]), generator
            )
            context = masks.draw_equal_counts(left, generator)
            drawn["context_ids"].append(tubes(context, times, everything.shape[1]))
            drawn["target_ids"].append(tubes(target, times, everything.shape[1])[:, None])
        return drawn

    def forward(
        self,
        touch: Tensor,
        context_ids: list[Int[Tensor, "b _"]],
        target_ids: list[Int[Tensor, "b 1 _"]],
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the loss: L1 distance of predicted and actual tokens, the mean over both masks."""
        images = self.backbone.stack(touch.float())
        targets, patches = self.targets(images), self.backbone.vit.embed_patches(images)
        losses = [
            F.l1_loss(self.predict(patches, context, target), gather_tokens(targets, target))
            for context, target in zip(context_ids, target_ids, strict=True)
        ]
        return {"loss": torch.stack(losses).mean()}


def tubes(ids: Int[Tensor, "b k"], times: int, patches: int) -> Int[Tensor, "b j"]:
    """Repeat patches at all times of a clip with `patches` patches per frame."""
    return torch.cat([ids + time * patches for time in range(times)], 1)

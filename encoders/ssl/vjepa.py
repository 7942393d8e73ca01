"""V-JEPA (Bardes et al. 2024; Sparsh) for touch: predict the tokens of hidden tubes of a clip."""

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from touchgoal.encoders.backbones.vit import patch_grid
from touchgoal.encoders.ssl.config import VJepaConfig
from touchgoal.encoders.ssl.masks import draw_equal_counts, draw_size, draw_targets, union_of_blocks
from touchgoal.encoders.ssl.predictor import ASPECT, JointEmbeddingPrediction, gather_tokens

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
        masks = (_SMALL_SCALE, config.small_blocks), (_LARGE_SCALE, _LARGE_BLOCKS)
        for scale, blocks in masks:
            size = draw_size(grid, (scale, scale), ASPECT, generator)
            hidden, left = draw_targets(grid, size, count, blocks, everything, 1, generator)
            target = draw_equal_counts(union_of_blocks(hidden, everything.shape[1]), generator)
            context = draw_equal_counts(left, generator)
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
        images = self.stacked(touch)
        targets, patches = self.targets(images), self.backbone.vit.embed_patches(images)
        losses = [
            F.l1_loss(self.predict(patches, context, target), gather_tokens(targets, target))
            for context, target in zip(context_ids, target_ids, strict=True)
        ]
        return {"loss": torch.stack(losses).mean()}


def tubes(ids: Int[Tensor, "b k"], times: int, patches: int) -> Int[Tensor, "b j"]:
    """Repeat patches at all times of a clip with `patches` patches per frame."""
    return torch.cat([ids + time * patches for time in range(times)], 1)

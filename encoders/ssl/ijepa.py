"""I-JEPA (Assran et al. 2023; Sparsh) for touch: predict the tokens of hidden blocks."""

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from touchgoal.encoders.backbones.vit import patch_grid
from touchgoal.encoders.ssl import masks
from touchgoal.encoders.ssl.predictor import ASPECT, JointEmbeddingPrediction, gather_tokens

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
        target, left = masks.draw_targets(
            grid, size, count, _TARGET_BLOCKS, context, self.min_context, generator
        )
        return {"context_ids": masks.draw_equal_counts(left, generator), "target_ids": target}

    def forward(
        self, touch: Tensor, context_ids: Int[Tensor, "b k"], target_ids: Int[Tensor, "b m j"]
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the loss: smooth L1 distance of predicted and actual tokens, as released."""
        images = self.stacked(touch)
        actual = gather_tokens(self.targets(images), target_ids)
        predicted = self.predict(self.backbone.vit.embed_patches(images), context_ids, target_ids)
        return {"loss": F.smooth_l1_loss(predicted, actual)}

"""Dense probe: tokens back to an image, for quantities such as a force field.

After DPT (Ranftl et al. 2021), with one stage: tokens are placed on their grid and refined by
convolutions between doublings of the resolution.
"""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.runtime.errors import UserError

_WIDTH = 48  # channels between the tokens and the planes


class DenseProbe(nn.Module):
    """Probe from the tokens of a grid of patches to planes of values."""

    def __init__(self, features: int, grid: tuple[int, int], planes: int, side: int) -> None:
        """Build a randomly initialised probe.

        Args:
            grid: Rows and columns of the patches. Tokens before them (a class token) are dropped;
                several times as many (clips) are averaged over time.
            side: Rows and columns of the output.
        """
        super().__init__()
        self.grid, self.side = grid, side
        self.norm = nn.LayerNorm(features)
        self.narrow = nn.Linear(features, _WIDTH)
        self.refine = nn.ModuleList(nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1) for _ in range(2))
        self.out = nn.Conv2d(_WIDTH, planes, 3, padding=1)

    def forward(self, tokens: Float[Tensor, "b t f"]) -> Float[Tensor, "b p s s"]:
        """Return the planes, unbounded; UserError for fewer tokens than patches."""
        patches = self.grid[0] * self.grid[1]
        times = tokens.shape[1] // patches
        if not times:
            raise UserError(f"{tokens.shape[1]} tokens are fewer than the grid's {patches} patches")
        placed = tokens[:, tokens.shape[1] - times * patches :].unflatten(1, (times, patches))
        x = self.narrow(self.norm(placed.mean(1))).transpose(1, 2).unflatten(2, self.grid)
        for i, convolution in enumerate(self.refine):
            size = (self.side // 2, self.side // 2) if i == 0 else (self.side, self.side)
            x = F.interpolate(x, size, mode="bilinear", align_corners=False)
            x = x + F.gelu(convolution(x))
        return self.out(x)

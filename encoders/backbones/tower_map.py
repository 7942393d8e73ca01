"""Map from a frozen tower's embeddings of images or sentences into a fixed touch embedding."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


class TowerMap(nn.Module):
    """Bias-free linear map of centred unit embeddings, with a hidden layer beside it if it has one.

    A linear map suffices for the sentences of about a hundred objects; for more, add the hidden layer.
    """

    mean: Float[Tensor, " k"]

    def __init__(self, tower_dim: int, touch_dim: int, hidden: int = 0) -> None:
        """Build it untrained; it begins as a linear map."""
        super().__init__()
        self.hidden = hidden
        self.register_buffer("mean", torch.zeros(tower_dim))
        self.linear = nn.Linear(tower_dim, touch_dim, bias=False)
        self.scale = tower_dim**0.5  # brings components of unit vectors to about 1
        self.up = nn.Linear(tower_dim, hidden) if hidden else None
        self.down = nn.Linear(hidden, touch_dim, bias=False) if hidden else None
        if self.down is not None:
            nn.init.zeros_(self.down.weight)

    def forward(self, embeddings: Float[Tensor, "*n k"]) -> Float[Tensor, "*n d"]:
        """Return unit vectors among the touch embeddings."""
        centred = F.normalize(embeddings, dim=-1) - self.mean
        touch = self.linear(centred)
        if self.up is not None and self.down is not None:
            touch = touch + self.down(F.gelu(self.up(self.scale * centred)))
        return F.normalize(touch, dim=-1)

    def centre(self, embeddings: Float[Tensor, "*n k"]) -> None:
        """Take the mean of these embeddings as the centre."""
        unit = F.normalize(embeddings, dim=-1).flatten(0, -2)
        self.mean.copy_(unit.mean(0))

    def turn(self, matrix: Float[Tensor, "d d"]) -> None:
        """Multiply the touch embeddings, before they are brought to unit length, by a matrix."""
        for layer in (self.linear, self.down):
            if layer is not None:
                layer.weight.data.copy_(matrix.T @ layer.weight)

"""Novelty of touch embeddings: the part that the training's variation does not explain."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

_COMPONENTS = 64
_FALSE_ALARMS = 0.05  # share of episodes like the training's that may exceed the limit
_LEAST = round(1 / _FALSE_ALARMS) - 1  # fewest held-out episodes that bound that share


class NoveltyDetector(nn.Module):
    """Distance of embeddings from the training's main principal components; 1 is the limit.

    Jackson and Mudholkar's Q statistic (Technometrics 21, 1979). It detects a displaced
    sensor, swapped colours, or one finger without contact, better than the distance to the nearest
    known embedding. Familiar touch at an unusual time stays unnoticed.
    """

    def __init__(self, dim: int) -> None:
        """Begin without a limit: until `fit` nothing is novel."""
        super().__init__()
        self.mean, self.scale = nn.Buffer(torch.zeros(dim)), nn.Buffer(torch.ones(dim))
        self.components = nn.Buffer(torch.zeros(dim, min(dim // 2, _COMPONENTS)))
        self.limit = nn.Buffer(torch.tensor(torch.inf))

    def fit(self, embedded: Float[Tensor, "n e"], lengths: Sequence[int], ticks: int) -> None:
        """Learn the components from every second episode, and the limit from the others.

        At most one in twenty of those exceeds it for `ticks` in a row (split conformal prediction).
        Fewer than 38 episodes are too few to tell: nothing is novel.
        """
        episodes = embedded.split(list(lengths))
        learned, others = torch.cat(episodes[::2]), episodes[1::2]
        self.mean.copy_(learned.mean(0))
        self.scale.copy_(learned.std(0).clamp(min=1e-6))
        _, axes = torch.linalg.eigh(((learned - self.mean) / self.scale).T.cov())
        self.components.copy_(axes[:, -self.components.shape[1] :])
        if len(others) >= _LEAST:
            found = [self._distance(e).unfold(0, min(ticks, len(e)), 1) for e in others]
            worst = torch.stack([lasting.amin(1).amax() for lasting in found]).sort().values
            self.limit.copy_(worst[math.ceil((len(worst) + 1) * (1 - _FALSE_ALARMS)) - 1])

    def forward(self, embedded: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Return the distance of embeddings, as a share of the limit."""
        return self._distance(embedded) / self.limit

    def _distance(self, embedded: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        scaled = (embedded - self.mean) / self.scale
        return (scaled - scaled @ self.components @ self.components.T).norm(dim=1)

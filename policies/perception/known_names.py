"""Whether a sentence fits an object at all, and which names fit what is seen.

The scores of a first look compare the objects of one image; they do not say whether a sentence fits any of
them. So an object's score is marked against objects seen in training: 0 is their mean, 1 what one of a hundred
of them exceeds. A sentence that fits an object much less than some name of the catalogue does means another.
"""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.policies.perception.target_words import embed
from touchgoal.sim_envs.scene.objects import CATALOGUE

NAMES = tuple(name.replace("_", " ") for name in CATALOGUE)
_KEPT, _BEST = 512, 0.99  # objects, and the quantile of their scores that is marked 1
_SEEN = 0.6  # least mark of a name that counts as seen
_APART = 24.0  # px; what is nearer to each other is one object


class KnownNames(nn.Module):
    """Marks of sentences on objects, by keys of objects seen in training."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.objects = nn.Buffer(torch.zeros(_KEPT, width))

    def fit(self, keys: Float[Tensor, "n c"]) -> None:
        """Keep some of these keys, evenly spaced."""
        self.objects.copy_(keys[torch.linspace(0, len(keys) - 1, _KEPT).long()])

    def marks(
        self, queries: Float[Tensor, "v c"], keys: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n v"]:
        """Return the mark of each query on each object's key."""
        scores = self.objects @ queries.mT
        mean, best = scores.mean(0), scores.quantile(_BEST, dim=0)
        return (keys @ queries.mT - mean) / (best - mean).clamp(min=1e-6)

    def seen(
        self,
        names: Float[Tensor, "v c"],
        maps: Float[Tensor, "c cells"],
        centres: Float[Tensor, "cells 2"],
    ) -> list[str]:
        """Return the likeliest name of each object in an image, the surest first."""
        cells = (names @ maps).argmax(1).unique()
        mark, name = self.marks(names, maps[:, cells].mT).max(1)
        found: list[tuple[Tensor, str]] = []
        for i in mark.argsort(descending=True).tolist():
            place = centres[cells[i]]
            if mark[i] > _SEEN and all((place - other).norm() > _APART for other, _ in found):
                found.append((place, NAMES[name[i]]))
        return list(dict.fromkeys(name for _, name in found))


@cache
def embedded_names() -> Float[Tensor, "v d"]:
    """Return the embeddings of `NAMES`."""
    return embed(NAMES)

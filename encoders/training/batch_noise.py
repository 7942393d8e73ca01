"""Random numbers of a batch that several processes share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

Drawn = TypeVar("Drawn")


@dataclass(frozen=True)
class BatchNoise:
    """Random numbers for one process's rows of a batch.

    Every process draws the numbers of the whole batch from the same generator and takes its own rows,
    so any number of processes trains with the same noise.
    """

    generator: torch.Generator  # generator on the CPU, in the same state in all processes
    rank: int = 0  # index of this process
    world: int = 1  # number of processes; each has as many rows of the batch

    def draw(self, rows: int, sample: Callable[[int, torch.Generator], Drawn]) -> Drawn:
        """Return this process's rows of `sample(rows of the whole batch, generator)`.

        `sample` returns a tensor, or a dict or list of such, with one entry per row.
        """
        own = slice(self.rank * rows, (self.rank + 1) * rows)
        return _take(sample(self.world * rows, self.generator), own)

    def randn(self, shape: torch.Size | tuple[int, ...]) -> Tensor:
        """Return normal numbers of this shape, rows first."""
        return self.draw(shape[0], lambda n, g: torch.randn(n, *shape[1:], generator=g))

    def rand(self, shape: torch.Size | tuple[int, ...]) -> Tensor:
        """Return uniform numbers in [0, 1) of this shape, rows first."""
        return self.draw(shape[0], lambda n, g: torch.rand(n, *shape[1:], generator=g))

    def randint(self, high: int, shape: torch.Size | tuple[int, ...]) -> Tensor:
        """Return integers from 0 to `high - 1` of this shape, rows first."""
        return self.draw(shape[0], lambda n, g: torch.randint(high, (n, *shape[1:]), generator=g))


def _take(drawn: Any, own: slice) -> Any:
    if isinstance(drawn, dict):
        return {name: _take(value, own) for name, value in drawn.items()}
    if isinstance(drawn, list):
        return [_take(value, own) for value in drawn]
    return drawn[own]

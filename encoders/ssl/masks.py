"""Blocks of patches that a network reads or predicts, drawn for a whole batch.

A block's size is drawn once per batch, so that its patches make a rectangular tensor; its place is
drawn for every image. Indices count row by row, as for `ViT.forward`; those of a block are sorted.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from touchgoal.runtime.errors import UserError

_TRIES = 100


def draw_size(
    grid: tuple[int, int],
    scale: tuple[float, float],
    aspect: tuple[float, float],
    generator: torch.Generator,
) -> tuple[int, int]:
    """Draw a block's rows and columns: its share of the patches, and its height over width."""
    share, ratio = (
        low + (high - low) * torch.rand((), generator=generator).item()
        for low, high in (scale, aspect)
    )
    area = share * grid[0] * grid[1]
    height, width = round((area * ratio) ** 0.5), round((area / ratio) ** 0.5)
    return min(max(height, 1), grid[0]), min(max(width, 1), grid[1])


def draw_blocks(
    grid: tuple[int, int],
    size: tuple[int, int],
    count: int,
    blocks: int,
    generator: torch.Generator,
) -> Int[Tensor, "{count} {blocks} k"]:
    """Draw the patches of `blocks` blocks of a size in each of `count` images; they may overlap."""
    starts = [
        torch.randint(0, whole - part + 1, (count, blocks, 1, 1), generator=generator)
        for whole, part in zip(grid, size, strict=True)
    ]
    rows = starts[0] + torch.arange(size[0])[:, None]
    columns = starts[1] + torch.arange(size[1])
    return (rows * grid[1] + columns).flatten(2)


def union_of_blocks(ids: Int[Tensor, "b m k"], patches: int) -> Bool[Tensor, "b {patches}"]:
    """Return whether each patch of an image is in one of its blocks."""
    return torch.zeros(len(ids), patches, dtype=torch.bool).scatter(1, ids.flatten(1), True)


def draw_equal_counts(
    allowed: Bool[Tensor, "b n"], generator: torch.Generator
) -> Int[Tensor, "b k"]:
    """Draw as many of the allowed patches of each image as the image with the fewest has."""
    fewest = int(allowed.sum(1).min())
    chance = torch.rand(allowed.shape, generator=generator).masked_fill(~allowed, -1.0)
    return chance.topk(fewest, 1).indices.sort(1).values


def draw_targets(
    grid: tuple[int, int],
    size: tuple[int, int],
    count: int,
    blocks: int,
    within: Bool[Tensor, "b n"],
    least: int,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "b m k"], Bool[Tensor, "b n"]]:
    """Draw target blocks; return them, and which patches of `within` they leave.

    An image with fewer than `least` patches left has its blocks drawn again.

    UserError: the grid is too small for that.
    """
    ids = draw_blocks(grid, size, count, blocks, generator)
    for _ in range(_TRIES):
        left = within & ~union_of_blocks(ids, within.shape[1])
        poor = left.sum(1) < least
        if not poor.any():
            return ids, left
        ids[poor] = draw_blocks(grid, size, int(poor.sum()), blocks, generator)
    raise UserError(
        f"{blocks} blocks of {size[0]} x {size[1]} patches leave hardly ever {least} of the "
        f"{grid[0]} x {grid[1]} to see: choose fewer or smaller blocks, or smaller patches"
    )

"""The average of a network's weights over its training, which acts better than the last ones."""

import torch
from torch import nn


def decay(step: int, power: float = 0.75, greatest: float = 0.9999) -> float:
    """Weight of the past after `step` updates; diffusion_policy's schedule and constants."""
    return min(greatest, 1 - (1 + step) ** -power)


@torch.no_grad()
def update(average: nn.Module, network: nn.Module, step: int) -> None:
    """Takes the network into its average, as the update number `step`, counted from 0."""
    share = 1 - decay(step)
    for mean, weight in zip(average.parameters(), network.parameters(), strict=True):
        mean.lerp_(weight, share)

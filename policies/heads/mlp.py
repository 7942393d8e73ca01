"""Multilayer perceptron from a condition to a chunk, by itself or as the denoiser of a diffusion."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.policies.heads.unet import sinusoidal_embedding


@dataclass(frozen=True)
class MLPConfig:
    """Width and number of the hidden layers."""

    width: int = 512
    depth: int = 3


def build_mlp(config: MLPConfig, inputs: int, outputs: int) -> nn.Sequential:
    """Return hidden layers with layer norm and Mish, and a linear layer."""
    layers: list[nn.Module] = []
    for _ in range(config.depth):
        layers += [nn.Linear(inputs, config.width), nn.LayerNorm(config.width), nn.Mish()]
        inputs = config.width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def readout(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Return a network with two hidden layers without norm, which reads numbers out of features."""
    return nn.Sequential(
        nn.Linear(inputs, width), nn.Mish(),
        nn.Linear(width, width), nn.Mish(),
        nn.Linear(width, outputs),
    )  # fmt: skip


class MLPDenoiser(nn.Module):
    """Network from noisy chunk, diffusion step and condition to a chunk of the same shape.

    Short chunks need no convolution over their ticks (IDQL, Hansen-Estruch et al. 2023, denoises
    single actions so).
    """

    _STEP_WIDTH = 64

    def __init__(self, config: MLPConfig, ticks: int, action_dim: int, condition_dim: int) -> None:
        super().__init__()
        values = ticks * action_dim
        self.network = build_mlp(config, values + self._STEP_WIDTH + condition_dim, values)

    def forward(
        self,
        noisy: Float[Tensor, "b h a"],
        step: Float[Tensor, " b"],
        condition: Float[Tensor, "b c"],
    ) -> Float[Tensor, "b h a"]:
        """Return the network's prediction for diffusion steps of 0 to about 100."""
        given = [noisy.flatten(1), sinusoidal_embedding(step, self._STEP_WIDTH), condition]
        return self.network(torch.cat(given, 1)).unflatten(1, noisy.shape[1:])

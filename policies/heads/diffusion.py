"""Heads that predict chunks of normalised actions: diffusion (Chi et al. 2023), and regression."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.trainer import gather_batch
from touchgoal.policies.config import SamplerConfig
from touchgoal.policies.heads.mlp import MLPConfig, MLPDenoiser, build_mlp
from touchgoal.policies.heads.samplers import add_noise, denoise
from touchgoal.policies.heads.unet import PRESETS, UNet, UNetConfig


@dataclass(frozen=True)
class DiffusionConfig:
    """Network and sampler of a diffusion head."""

    denoiser: UNetConfig | MLPConfig = field(default_factory=lambda: PRESETS["small"])
    sampler: SamplerConfig = field(default_factory=SamplerConfig)


class Diffusion(nn.Module):
    """Sampler of chunks from the distribution of the demonstrations."""

    def __init__(self, config: DiffusionConfig, ticks: int, action_dim: int, condition_dim: int):
        super().__init__()
        self.config = config
        self._shape = ticks, action_dim
        if isinstance(config.denoiser, MLPConfig):
            self.network = MLPDenoiser(config.denoiser, ticks, action_dim, condition_dim)
        else:
            self.network = UNet(config.denoiser, action_dim, condition_dim)

    def loss(
        self,
        chunk: Float[Tensor, "b h a"],
        condition: Float[Tensor, "b c"],
        noise: BatchNoise,
        is_pad: Bool[Tensor, "b h"] | None = None,
    ) -> Float[Tensor, ""]:
        """Return the mean error at random steps, without padded ticks."""
        sampler = self.config.sampler
        noisy, step, target = add_noise(sampler, chunk, noise)
        error = self.network(noisy, step, condition) - target
        return masked_mean(error.abs() if sampler.loss == "absolute" else error.square(), is_pad)

    def sample(
        self, condition: Float[Tensor, "b c"], generator: torch.Generator
    ) -> Float[Tensor, "b h a"]:
        """Draw a chunk for every condition; the generator is on the CPU."""
        noise = torch.randn(len(condition), *self._shape, generator=generator).to(condition)
        return denoise(
            self.config.sampler, lambda x, t: self.network(x, t, condition), noise, generator
        )


class Regression(nn.Module):
    """Prediction of the median of the demonstrations, by the absolute error as in ACT (Zhao et al.
    2023).

    Unlike a squared error it weighs small motions like large ones, and chooses one of several
    modes.
    """

    def __init__(self, config: MLPConfig, ticks: int, action_dim: int, condition_dim: int):
        super().__init__()
        self._shape = ticks, action_dim
        self.network = build_mlp(config, condition_dim, ticks * action_dim)

    def loss(
        self,
        chunk: Float[Tensor, "b h a"],
        condition: Float[Tensor, "b c"],
        noise: BatchNoise,
        is_pad: Bool[Tensor, "b h"] | None = None,
    ) -> Float[Tensor, ""]:
        """Return the mean absolute error without padded ticks; nothing is random."""
        return masked_mean((self._predict(condition) - chunk).abs(), is_pad)

    def sample(
        self, condition: Float[Tensor, "b c"], generator: torch.Generator
    ) -> Float[Tensor, "b h a"]:
        """Predict the chunk for every condition; nothing is random."""
        return self._predict(condition)

    def _predict(self, condition: Float[Tensor, "b c"]) -> Float[Tensor, "b h a"]:
        return self.network(condition).unflatten(1, self._shape)


def masked_mean(
    error: Float[Tensor, "b h a"], is_pad: Bool[Tensor, "b h"] | None
) -> Float[Tensor, ""]:
    """Return the mean over the ticks of all processes that are not padding; 0 if all are."""
    if is_pad is None:
        return error.mean()
    valid = ~is_pad[..., None]
    # Each process sums over its own rows, so all must divide by the same count.
    count = gather_batch(valid.sum()[None]).float().mean()
    return (error * valid).sum() / (count * error.shape[-1]).clamp(min=1)

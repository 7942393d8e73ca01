"""Heads that predict chunks of normalised actions: diffusion (Chi et al. 2023), and regression.

Samples are noised and denoised by DDPM, DDIM or flow matching; DDPM and DDIM are one formula (Song et al.
2021, eq. 12).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.trainer import gather_batch
from touchgoal.policies.config import SamplerConfig
from touchgoal.policies.heads.mlp import MLPConfig, MLPDenoiser, build_mlp
from touchgoal.policies.heads.unet import UNet, UNetConfig

# the network's step at flow time 1: its step embedding cannot resolve 0 to 1
FLOW_TIME_SCALE = 100.0
DenoisingNetwork = Callable[[Float[Tensor, "b h a"], Float[Tensor, " b"]], Float[Tensor, "b h a"]]


@lru_cache
def alphas_cumprod(steps: int) -> Float[Tensor, " {steps}"]:
    """Return alpha-bar, the share of signal in the variance after each step, float64."""
    t = torch.arange(steps + 1, dtype=torch.float64) / steps
    power = torch.cos((t + 0.008) / 1.008 * torch.pi / 2) ** 2
    return (1 - (1 - power[1:] / power[:-1]).clamp(max=0.999)).cumprod(0)


def add_noise(
    config: SamplerConfig, clean: Float[Tensor, "b h a"], noise: BatchNoise
) -> tuple[Float[Tensor, "b h a"], Float[Tensor, " b"], Float[Tensor, "b h a"]]:
    """Return noisy samples, each at a random step, these steps, and the network's targets."""
    b = len(clean)
    added = noise.randn(clean.shape).to(clean)
    if config.kind == "flow":
        time = noise.rand((b,)).to(clean)
        t = time[:, None, None]
        return (1 - t) * added + t * clean, FLOW_TIME_SCALE * time, clean
    step = noise.randint(config.num_train_timesteps, (b,))
    power = alphas_cumprod(config.num_train_timesteps)[step].to(clean)[:, None, None]
    noisy = power.sqrt() * clean + (1 - power).sqrt() * added
    return noisy, step.to(clean), added if config.prediction_type == "epsilon" else clean


def denoise(
    config: SamplerConfig,
    network: DenoisingNetwork,
    noise: Float[Tensor, "b h a"],
    generator: torch.Generator,
) -> Float[Tensor, "b h a"]:
    """Draw samples.

    Args:
        network: from noisy samples and step to its prediction.
        noise: standard normal.
        generator: of the noise that "ddpm" adds, on the CPU.
    """
    x, count = noise, config.num_inference_steps
    if config.kind == "flow":
        for i in range(count):
            clean = network(x, x.new_full((len(x),), FLOW_TIME_SCALE * i / count))
            x = x + (clean.clamp(-config.clip, config.clip) - x) / (count - i)
        return x
    # "trailing", from pure noise on (Lin et al. 2024)
    share = torch.arange(count, 0, -1, dtype=torch.float64) / count
    steps = ((share * config.num_train_timesteps).round().long() - 1).tolist()
    powers = alphas_cumprod(config.num_train_timesteps)[steps].tolist()
    for step, power, after in zip(steps, powers, [*powers[1:], 1.0], strict=True):
        answer = network(x, x.new_full((len(x),), step))
        if config.prediction_type == "epsilon":
            answer = (x - (1 - power) ** 0.5 * answer) / power**0.5
        clean = answer.clamp(-config.clip, config.clip)
        # from the clipped sample, so that the step is DDPM's posterior even where it clips
        noise = (x - power**0.5 * clean) / (1 - power) ** 0.5
        fresh = 0.0
        if config.kind == "ddpm":
            fresh = ((1 - after) / (1 - power) * (1 - power / after)) ** 0.5
        x = after**0.5 * clean + max(1 - after - fresh**2, 0.0) ** 0.5 * noise
        if fresh > 0:
            x = x + fresh * torch.randn(x.shape, generator=generator).to(x)
    return x


@dataclass(frozen=True)
class DiffusionConfig:
    """Network and sampler of a diffusion head."""

    denoiser: UNetConfig | MLPConfig = MLPConfig()
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
        is_pad: Bool[Tensor, "b h"],
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
        is_pad: Bool[Tensor, "b h"],
    ) -> Float[Tensor, ""]:
        """Return the mean absolute error without padded ticks; nothing is random."""
        return masked_mean((self.sample(condition) - chunk).abs(), is_pad)

    def sample(
        self, condition: Float[Tensor, "b c"], generator: torch.Generator | None = None
    ) -> Float[Tensor, "b h a"]:
        """Predict the chunk for every condition; nothing is random."""
        return self.network(condition).unflatten(1, self._shape)


def masked_mean(error: Float[Tensor, "b h a"], is_pad: Bool[Tensor, "b h"]) -> Float[Tensor, ""]:
    """Return the mean over the ticks of all processes that are not padding; 0 if all are."""
    valid = ~is_pad[..., None]
    # Each process sums over its own rows, so all must divide by the same count.
    count = gather_batch(valid.sum()[None]).float().mean()
    return (error * valid).sum() / (count * error.shape[-1]).clamp(min=1)

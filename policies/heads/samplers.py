"""Noising and denoising of samples: DDPM, DDIM and flow matching.

DDPM and DDIM are one formula (Song et al. 2021, eq. 12).
"""

from collections.abc import Callable
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.policies.config import SamplerConfig

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
        t = _broadcast(time, clean)
        target = clean - added if config.prediction_type == "velocity" else clean
        return (1 - t) * added + t * clean, FLOW_TIME_SCALE * time, target
    step = noise.randint(config.num_train_timesteps, (b,))
    power = _broadcast(alphas_cumprod(config.num_train_timesteps)[step].to(clean), clean)
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
    walk = _denoise_flow if config.kind == "flow" else _denoise_diffusion
    return walk(config, network, noise, generator)


def _denoise_flow(
    config: SamplerConfig, network: DenoisingNetwork, x: Tensor, generator: torch.Generator
) -> Tensor:
    n = config.num_inference_steps
    for i in range(n):
        answer = network(x, x.new_full((len(x),), FLOW_TIME_SCALE * i / n))
        clean = answer if config.prediction_type == "sample" else x + (1 - i / n) * answer
        x = x + (clean.clamp(-config.clip, config.clip) - x) / (n - i)
    return x


def _denoise_diffusion(
    config: SamplerConfig, network: DenoisingNetwork, x: Tensor, generator: torch.Generator
) -> Tensor:
    # "trailing", from pure noise on (Lin et al. 2024)
    count = config.num_inference_steps
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


def _broadcast(values: Float[Tensor, " b"], like: Float[Tensor, "b h a"]) -> Tensor:
    return values.reshape(-1, *[1] * (like.ndim - 1))

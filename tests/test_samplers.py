"""Samplers against closed forms and against diffusers; the U-Net against the published one."""

from typing import Any, Literal

import pytest
import torch
from toy_policies import torch_rng

from touchgoal.policies.config import SamplerConfig
from touchgoal.policies.heads.samplers import FLOW_TIME_SCALE, denoise
from touchgoal.policies.heads.unet import PRESETS, UNet

MEAN, DEVIATION = 0.4, 0.3  # of the Gaussian that the exact flow knows


def test_unet_is_the_published_one() -> None:
    """Parameters of diffusion_policy's network for 7 actions and 1550 conditions: 87.4 M."""
    with torch.device("meta"):
        published = UNet(PRESETS["published"], 7, 1550)
    assert sum(p.numel() for p in published.parameters()) == 87_439_623
    small = UNet(PRESETS["tiny"], 7, 5)
    chunk, step, condition = torch.randn(3, 8, 7), torch.tensor([0.0, 50.0, 99.0]), torch.ones(3, 5)
    out = small(chunk, step, condition)
    assert out.shape == chunk.shape
    assert not torch.allclose(small(chunk, step + 1, condition), out, atol=1e-5)
    assert not torch.allclose(small(chunk, step, condition + 1), out, atol=1e-5)


def exact_flow(x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Return the velocity that takes noise to samples of one Gaussian."""
    t = step[0] / FLOW_TIME_SCALE
    gain = (t * DEVIATION**2 - (1 - t)) / (t**2 * DEVIATION**2 + (1 - t) ** 2)
    return MEAN + gain * (x - t * MEAN)


@pytest.mark.parametrize("predicted", ["velocity", "sample"])
def test_the_exact_flow_gives_the_gaussian_back(predicted: Literal["velocity", "sample"]) -> None:
    def network(x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        velocity = exact_flow(x, step)
        return (
            velocity if predicted == "velocity" else x + (1 - step[0] / FLOW_TIME_SCALE) * velocity
        )

    noise = torch.randn(4000, 4, 1, generator=torch_rng())
    config = SamplerConfig("flow", predicted, num_inference_steps=200, clip=9)
    samples = denoise(config, network, noise, torch_rng(1))
    assert samples.mean().item() == pytest.approx(MEAN, abs=0.01)
    assert samples.std().item() == pytest.approx(DEVIATION, rel=0.03)


@pytest.mark.parametrize("predicted", ["epsilon", "sample"])
@pytest.mark.parametrize("kind", ["ddpm", "ddim"])
def test_samplers_equal_diffusers(kind: Any, predicted: Any) -> None:
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler  # here: it takes 3 s
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

    options: dict[str, Any] = {"num_train_timesteps": 100, "prediction_type": predicted}
    options |= {"beta_schedule": "squaredcos_cap_v2", "timestep_spacing": "trailing"}
    theirs: Any = (DDPMScheduler if kind == "ddpm" else DDIMScheduler)(**options)
    steps = 100 if kind == "ddpm" else 10
    theirs.set_timesteps(steps)
    config = SamplerConfig(kind, predicted, num_inference_steps=steps)
    x = noise = torch.randn(3, 8, 2, generator=torch_rng())
    generator, more = torch_rng(1), {"use_clipped_model_output": True} if kind == "ddim" else {}
    for t in theirs.timesteps:
        x = theirs.step(x.tanh(), t, x, generator=generator, **more).prev_sample
    ours = denoise(config, lambda x, t: x.tanh(), noise, torch_rng(1))
    torch.testing.assert_close(ours, x, atol=1e-3, rtol=1e-3)

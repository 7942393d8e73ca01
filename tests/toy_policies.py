"""Policies, windows and observations small enough to test with."""

import numpy as np
import torch

from touchgoal.control import features as ft
from touchgoal.encoders.backbones.touch_backbone import TouchTrunk, TouchTrunkConfig
from touchgoal.encoders.backbones.vit import PRESETS as VITS
from touchgoal.policies.heads.diffusion import DiffusionConfig
from touchgoal.policies.heads.samplers import SamplerConfig
from touchgoal.policies.heads.unet import PRESETS
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.policies.policy import WRENCH_DIM, Policy, PolicyConfig
from touchgoal.policies.training.sequence_dataset import Recorded, Windows

DIFFUSION = DiffusionConfig(PRESETS["tiny"], SamplerConfig(plan_steps=5))
FLOW = DiffusionConfig(PRESETS["tiny"], SamplerConfig("flow", plan_steps=5))
TOY = PolicyConfig(touch_dim=6, touch="toy", touch_width=8, head=DIFFUSION)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def toy_windows(config: PolicyConfig, lengths: tuple[int, ...] = (9, 14), seed: int = 0) -> Windows:
    n, generator = sum(lengths), rng(seed)
    touch = torch.randn(n, config.touch_dim, generator=generator).half()
    state = 0.02 * torch.randn(n, config.state_dim, generator=generator)
    actions = 0.01 * torch.randn(n, 8, generator=generator)
    actions[:, 7] = 0.0  # a gripper that stays, as in the bead maze
    wrench = touch.float().sum(1, keepdim=True).repeat(1, WRENCH_DIM)
    return Windows(
        Recorded(touch, state, actions, lengths, wrench=wrench if config.reads_wrench else None),
        config,
    )


def policy_for(config: PolicyConfig, windows: Windows, seed: int = 0) -> Policy:
    torch.manual_seed(seed)
    policy, recorded = Policy(config), windows.recorded
    touch, actions = recorded.touch.float(), windows.actions
    policy.fit_scales(touch, recorded.state, windows.joints, actions, recorded.wrench)
    return policy


def feeling() -> TouchEmbedder:
    torch.manual_seed(0)
    trunk = TouchTrunk(TouchTrunkConfig.for_sensor(VITS["tiny"], "gelsight_mini"))
    return TouchEmbedder(trunk.eval(), "toy")


def toy_ticks(n: int) -> list[dict[str, np.ndarray]]:
    generator = np.random.default_rng(1)
    return [
        {
            ft.STATE: generator.normal(size=15).astype(np.float32),
            ft.TCP_POSE: generator.normal(size=7).astype(np.float32),
            **{k: generator.integers(0, 255, (6, 8, 3), np.uint8) for k in ft.TACTILE},
        }
        for _ in range(n)
    ]

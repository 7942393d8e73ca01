"""Policies, windows and observations small enough to test with."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from touchgoal.control import features as ft
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS as VITS
from touchgoal.policies.config import SamplerConfig
from touchgoal.policies.heads.diffusion import DiffusionConfig
from touchgoal.policies.heads.unet import PRESETS
from touchgoal.policies.network import PolicyConfig, PolicyNetwork
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.policies.training.sequence_dataset import Recordings, SequenceDataset

DIFFUSION = DiffusionConfig(PRESETS["tiny"], SamplerConfig(num_inference_steps=5))
FLOW = DiffusionConfig(PRESETS["tiny"], SamplerConfig("flow", num_inference_steps=5))
TOY = PolicyConfig(touch_dim=6, touch="toy", touch_projection_dim=8, head=DIFFUSION)


def torch_rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def toy_dataset(
    config: PolicyConfig, lengths: tuple[int, ...] = (9, 14), seed: int = 0
) -> SequenceDataset:
    n, generator = sum(lengths), torch_rng(seed)
    touch = torch.randn(n, config.touch_dim, generator=generator).half()
    width = sum(ft.FEATURES[key].shape[0] for key in config.proprioception)
    state = 0.02 * torch.randn(n, width, generator=generator)
    actions = 0.01 * torch.randn(n, 8, generator=generator)
    actions[:, 7] = 0.0  # a gripper that stays, as in the bead maze
    done = torch.cat([torch.arange(length) >= length - 10 for length in lengths])
    recorded = Recordings(touch, state, actions, lengths, done, torch.zeros(n).bool())
    return SequenceDataset(recorded, config)


def toy_policy(config: PolicyConfig, windows: SequenceDataset, seed: int = 0) -> PolicyNetwork:
    torch.manual_seed(seed)
    policy, recorded = PolicyNetwork(config), windows.recorded
    touch, actions = recorded.touch.float(), windows.actions
    policy.fit_normalizers(touch, recorded.state, windows.joints, actions, windows.action_is_pad)
    return policy


def toy_network(**changes: Any) -> PolicyNetwork:
    """A network for inference; `changes` of the toy config."""
    config = replace(TOY, **changes)
    return toy_policy(config, toy_dataset(config)).eval()


def toy_touch_embedder() -> TouchEmbedder:
    torch.manual_seed(0)
    backbone = TouchBackbone(TouchBackboneConfig.for_sensor(VITS["tiny"], "gelsight_mini"))
    return TouchEmbedder(backbone.eval(), "toy")


def toy_observations(n: int) -> list[dict[str, np.ndarray]]:
    generator = np.random.default_rng(1)
    return [
        {
            ft.STATE: generator.normal(size=15).astype(np.float32),
            ft.TCP_POSE: generator.normal(size=7).astype(np.float32),
            **{k: generator.integers(0, 255, (6, 8, 3), np.uint8) for k in ft.TACTILE},
        }
        for _ in range(n)
    ]

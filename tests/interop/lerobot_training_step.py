"""One training step of lerobot's ACT and diffusion policy on a set that touchgoal recorded.

python lerobot_training_step.py SET     in lerobot's environment, with diffusers
"""

import math
import sys

import torch
from lerobot.configs import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features

KEYS = ("observation.state", "observation.images.wrist", "action")
HORIZON = 8  # actions of a plan; a multiple of 8 for the U-Net
SMALL = {"device": "cpu", "pretrained_backbone_weights": None}


def train(name: str, config_type: type, policy_type: type, root: str, **options: object) -> None:
    meta = LeRobotDatasetMetadata("toy/own", root=root)
    features = {k: f for k, f in dataset_to_policy_features(meta.features).items() if k in KEYS}
    config = config_type(
        input_features={k: f for k, f in features.items() if f.type is not FeatureType.ACTION},
        output_features={k: f for k, f in features.items() if f.type is FeatureType.ACTION},
        **SMALL,
        **options,
    )
    past, ahead = config.observation_delta_indices or [0], config.action_delta_indices
    steps = {key: ahead if key == "action" else past for key in KEYS}
    delta = {key: [k / meta.fps for k in ticks] for key, ticks in steps.items()}
    if config.observation_delta_indices is None:
        delta = {"action": delta["action"]}
    dataset = LeRobotDataset("toy/own", root=root, delta_timestamps=delta, video_backend="pyav")
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True)))
    policy = policy_type(config).train()
    preprocess, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
    optimizer = torch.optim.AdamW(policy.parameters(), 1e-4)
    losses = []
    for _ in range(2):
        loss, _ = policy(preprocess(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    print(f"{name}: loss {losses[0]:.3f}, after one step {losses[1]:.3f}")
    assert all(map(math.isfinite, losses))


def main() -> None:
    torch.manual_seed(0)
    root = sys.argv[1]
    plan = {"n_action_steps": HORIZON}
    small = {"dim_model": 64, "n_heads": 2, "dim_feedforward": 64, "chunk_size": HORIZON}
    train("ACT", ACTConfig, ACTPolicy, root, **plan, **small)
    u_net = {"down_dims": (32, 64, 128), "horizon": HORIZON, "n_action_steps": 4}
    train("DiffusionPolicy", DiffusionConfig, DiffusionPolicy, root, **u_net)


if __name__ == "__main__":
    main()

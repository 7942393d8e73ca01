"""touchgoal's reward through lerobot's interfaces, in lerobot's environment: `lerobot_plugins.py` runs it.

python tests/interop/lerobot_reward.py SET COSTS      COSTS: touchgoal's own, .npy
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import lerobot_env_touchgoal  # noqa: F401  registers the reward, as an installed plugin does
import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.rewards.factory import (
    get_reward_model_class,
    make_reward_model,
    make_reward_model_config,
    make_reward_pre_post_processors,
)
from lerobot.rewards.sarm.rabc import RABCWeights
from lerobot_reward_touchgoal import COLUMN, TouchgoalRewardModel, label

CHUNK = 16


def main() -> None:
    root, own = Path(sys.argv[1]), 1 - np.load(sys.argv[2])
    dataset = LeRobotDataset("touchgoal/reward", root=root)
    config = make_reward_model_config("touchgoal", fps=dataset.fps, object="wooden_block")
    model = make_reward_model(config)
    assert get_reward_model_class("touchgoal") is type(model) and not model.is_trainable
    before, _ = make_reward_pre_post_processors(config)
    file = label(model, dataset)
    labelled = pq.read_table(file)[COLUMN].to_numpy()
    off = np.abs(labelled - own).max()
    print(f"labels of {len(labelled)} frames: largest difference from reward-curves {off:.1e}")
    assert off < 1e-3

    frames = [dataset[i] for i in range(12)]
    batch = before(
        {k: torch.stack([f[k] for f in frames]) for k in frames[0] if k.startswith("observation.")}
    )
    run = {key: value[None] for key, value in batch.items() if isinstance(value, torch.Tensor)}
    with TemporaryDirectory() as name:
        model.save_pretrained(name)
        assert "touchgoal" in (Path(name) / "README.md").read_text()
        kept = TouchgoalRewardModel.from_pretrained(name)
        whole = kept.compute_reward(run)
    assert torch.equal(whole, model.compute_reward(run)) and whole.shape == (1,)
    model.reset()
    ticks = [float(model.compute_reward({k: v[:, i] for k, v in run.items()})) for i in range(12)]
    print(f"tick by tick: {ticks[-1]:.4f}, as one run: {float(whole):.4f}")
    assert abs(ticks[-1] - float(whole)) < 1e-3

    weights = RABCWeights(file, chunk_size=CHUNK)
    sample = {"index": torch.arange(0, len(labelled), 7)}
    found = weights.compute_batch_weights(sample)
    print(
        f"lerobot's RA-BC weighs {len(sample['index'])} samples: {found[0].min():.2f} to {found[0].max():.2f}"
    )


if __name__ == "__main__":
    main()

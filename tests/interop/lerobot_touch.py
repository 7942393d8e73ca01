"""lerobot-train of ACT and diffusion policy with frozen touch on SET, in lerobot's environment; OUT is for the runs.

python tests/interop/lerobot_touch.py SET OUT
"""

import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts import lerobot_train
from lerobot_policy_touch import ActTouchPolicy, DiffusionTouchPolicy

from touchgoal.control.features import TACTILE
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.perception.frozen_touch import load_touch

TOUCH, STATE = "gelsight_mini_markers", "observation.environment_state"
SMALL = {
    "act_touch": "--policy.dim_model=64 --policy.n_encoder_layers=1 --policy.use_vae=false",
    "diffusion_touch": "--policy.down_dims=[64,128] --policy.num_train_timesteps=10",
}


def main() -> None:
    root, out = map(Path, sys.argv[1:])
    own = load_touch(TOUCH).embed(EpisodeSet(root), 0)
    for name, policy in (("act_touch", ActTouchPolicy), ("diffusion_touch", DiffusionTouchPolicy)):
        seen, forward = [], policy.forward

        def watched(self, batch: dict, *more: object, seen: list = seen, forward: object = forward):  # noqa: ANN202
            seen.append((batch["index"], batch[STATE].clone()))
            return forward(self, batch, *more)

        policy.forward = watched
        words = f"--policy.type={name} --policy.touch={TOUCH} --policy.data={root} {SMALL[name]}"
        words += f" --dataset.repo_id=touchgoal/maze --dataset.root={root} --batch_size=8 --num_workers=0"
        words += (
            f" --steps=2 --output_dir={out / name} --policy.push_to_hub=false --env_eval_freq=0"
        )
        sys.argv[1:] = words.split()
        lerobot_train.main()
        index, felt = seen[0]
        apart = max(
            np.abs(f.numpy()[-1 if f.ndim > 1 else ...] - own[i]).max()
            for i, f in zip(index, felt, strict=True)
        )
        assert apart < 1e-5, f"{name}: touch differs from touchgoal's by {apart}"
        act(name, policy, out / name / "checkpoints" / "last" / "pretrained_model", root, own)


def act(name: str, policy: type, folder: Path, root: Path, own: np.ndarray) -> None:
    """Act in the first ticks of the episode with the saved policy and its saved processors."""
    actor = policy.from_pretrained(folder)
    before, after = make_pre_post_processors(actor.config, str(folder))
    data = LeRobotDataset("touchgoal/maze", root=root)
    for reset in (actor.reset, before.reset):
        reset()
    for tick in range(20):
        frame = {k: v for k, v in data[tick].items() if k in (*TACTILE, "observation.state")}
        ready = before(frame)
        action = after(actor.select_action(ready))
        assert torch.isfinite(action).all() and action.shape == (1, 8)
        apart = np.abs(ready[STATE][0].numpy() - own[tick]).max()
        assert apart < 1e-5, f"{name}: touch in use differs by {apart} at tick {tick}"
    print(f"{name}: trained, saved and acting; touch equals touchgoal's within {apart:.1e}")


if __name__ == "__main__":
    main()

"""lerobot-train of a policy of touchgoal on SET, in lerobot's environment; the steps go to OUT/steps.json."""

import json
import sys
from pathlib import Path

import torch
from lerobot.scripts import lerobot_train
from lerobot_policy_touchgoal import TouchgoalPolicy


def main() -> None:
    root, out = map(Path, sys.argv[1:])
    steps, forward = [], TouchgoalPolicy.forward

    def seeded(policy: TouchgoalPolicy, batch: dict) -> tuple:
        torch.manual_seed(len(steps))
        loss, more = forward(policy, batch)
        steps.append((batch["index"].tolist(), loss.item()))
        return loss, more

    TouchgoalPolicy.forward = seeded
    policy = f"--policy.type=touchgoal --policy.policy=bead-maze --policy.data={root}"
    data = f"--dataset.repo_id=touchgoal/maze --dataset.root={root} --batch_size=32 --num_workers=0"
    run = f"--steps=2 --output_dir={out} --policy.push_to_hub=false --env_eval_freq=0"
    config = out / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    for words in (f"{policy} {data} {run}", f"--config_path={config} --resume=true --steps=3"):
        sys.argv[1:] = words.split()
        lerobot_train.main()
    assert len(steps) == 3
    (out / "steps.json").write_text(json.dumps(steps))


if __name__ == "__main__":
    main()

"""touchgoal's policy in touchgoal's environment by lerobot-eval, against touchgoal's own loop.

    python tests/interop/lerobot_plugins.py PYTHON      PYTHON: of an environment with lerobot

`make interop-lerobot` runs it.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import touchgoal
from touchgoal.control.features import TRUTH_SUCCESS
from touchgoal.policies.acting import LearnedPolicy

ROOT = Path(__file__).resolve().parents[2]
TASK, FIRST_SEED, EPISODES = "pick-place", 1000, 2


def evaluate_with_lerobot(python: Path, folder: Path) -> list[tuple[float, bool]]:
    """Return the summed reward and the success of each episode, by lerobot-eval."""
    plugins, out = folder / "plugins", folder / "eval"
    install = [python, "-m", "pip", "install", "-q", "--no-deps", "--target", plugins]
    subprocess.run([*install, ROOT / "plugins"], check=True)
    options = {
        "policy.type": "touchgoal",
        "policy.policy": TASK,
        "env.type": "touchgoal",
        "env.task": TASK,
        "env.for_policy": TASK,
        "eval.n_episodes": EPISODES,
        "eval.batch_size": 1,
        "seed": FIRST_SEED,
        "output_dir": out,
    }
    subprocess.run(
        [python.parent / "lerobot-eval", *(f"--{name}={value}" for name, value in options.items())],
        env=os.environ | {"PYTHONPATH": f"{plugins}:{ROOT / 'src'}", "HF_HUB_OFFLINE": "1"},
        check=True,
        capture_output=True,
    )
    metrics = json.loads((out / "eval_info.json").read_text())["per_task"][0]["metrics"]
    return list(zip(metrics["sum_rewards"], metrics["successes"], strict=True))


def evaluate_here() -> list[tuple[float, bool]]:
    """Return the same by touchgoal alone."""
    policy = touchgoal.load_policy(TASK)
    assert isinstance(policy, LearnedPolicy)
    env, found = touchgoal.make(TASK, config=policy.env_config()), []
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        observation, info = env.reset(seed=seed)
        policy.reset()
        total, ended = 0.0, False
        while not ended:
            observation, reward, done, late, info = env.step(policy.act(observation))
            total, ended = total + reward, done or late
        found.append((total, bool(info[TRUTH_SUCCESS][0])))
    return found


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        theirs = evaluate_with_lerobot(Path(sys.argv[1]).absolute(), Path(folder))
    here = evaluate_here()
    print(f"{'seed':>6}{'lerobot-eval':>14}{'success':>9}{'touchgoal':>11}{'success':>9}")
    for i, ((reward, success), (own, own_success)) in enumerate(zip(theirs, here, strict=True)):
        print(f"{FIRST_SEED + i:>6}{reward:>14.4f}{success!s:>9}{own:>11.4f}{own_success!s:>9}")
    same = all(abs(a[0] - b[0]) < 1e-4 and a[1] == b[1] for a, b in zip(theirs, here, strict=True))
    sys.exit(0 if same else "lerobot-eval and touchgoal differ")


if __name__ == "__main__":
    main()

"""touchgoal's policy by lerobot-eval and lerobot-train, against touchgoal's own loops; its reward, a twin's arm
and a fingertip through lerobot's interfaces.

    python tests/interop/lerobot_plugins.py PYTHON      PYTHON: of an environment with lerobot

`make interop-lerobot` runs it.
"""

import json
import os
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
import numpy as np  # noqa: E402
import torch  # noqa: E402
from running_twin import RunningTwin  # noqa: E402

import touchgoal  # noqa: E402
from touchgoal.control.features import TRUTH_SUCCESS  # noqa: E402
from touchgoal.encoders.training.batch_noise import BatchNoise  # noqa: E402
from touchgoal.episodes.store import EpisodeSet  # noqa: E402
from touchgoal.policies.acting import LearnedPolicy  # noqa: E402
from touchgoal.policies.checkpoint import SavedPolicy  # noqa: E402
from touchgoal.policies.training import sequence_dataset as data  # noqa: E402
from touchgoal.policies.training.train import make_batch  # noqa: E402

ROOT = HERE.parents[1]
TWIN = ["--lock-step", "--env.objects", "wooden_block", "--env.cameras", "front"]
TASK, FIRST_SEED, EPISODES = "pick-place", 1000, 2


def run_with_plugins(folder: Path, *command: str | Path) -> str:
    """Run a command of lerobot's environment with the plugins in `folder`; return what it prints."""
    path = {"PYTHONPATH": f"{folder}:{ROOT / 'src'}", "HF_HUB_OFFLINE": "1"}
    done = subprocess.run(command, env=os.environ | path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def record(out: Path, *options: str) -> Path:
    """Record an episode by the expert; return its set."""
    command = [sys.executable, "-m", "touchgoal.launch", "collect-demos", "--episodes", "1"]
    subprocess.run([*command, *options, "--out", out], check=True, stdout=subprocess.DEVNULL)
    return out / "episodes"


def train_with_lerobot(python: Path, plugins: Path, folder: Path) -> None:
    """Train the maze's policy on frozen touch by lerobot-train; its first loss must be touchgoal's."""
    root, out = record(folder / "maze", "--task", "bead-maze"), folder / "trained"
    print(run_with_plugins(plugins, python, HERE / "lerobot_touch.py", root, folder / "touch"))
    run_with_plugins(plugins, python, HERE / "lerobot_policy.py", root, out)
    (rows, theirs), *_ = json.loads((out / "steps.json").read_text())
    episodes, actor = EpisodeSet(root), touchgoal.load_policy("bead-maze")
    recorded = data.load_recordings(episodes, [0], actor.config, actor.touch)
    batch = make_batch(data.SequenceDataset(recorded, actor.config), torch.tensor(rows))
    network = SavedPolicy(actor.directory).network()
    torch.manual_seed(0)
    own = network(**batch, noise=BatchNoise(torch.default_generator))["loss"].item()
    print(f"loss of {len(rows)} windows by lerobot-train {theirs:.7f}, by touchgoal {own:.7f}")
    assert abs(own - theirs) < 1e-5 * own
    trained = touchgoal.load_policy(out / "checkpoints" / "last" / "pretrained_model")
    before, after = (SavedPolicy(p.directory).network().state_dict() for p in (actor, trained))
    assert any(not torch.equal(weight, after[name]) for name, weight in before.items())


def evaluate_with_lerobot(python: Path, plugins: Path, out: Path) -> list[tuple[float, bool]]:
    """Return the summed reward and the success of each episode, by lerobot-eval."""
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
    named = (f"--{name}={value}" for name, value in options.items())
    run_with_plugins(plugins, python.parent / "lerobot-eval", *named)
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
    python = Path(sys.argv[1]).absolute()
    with tempfile.TemporaryDirectory() as name:
        folder, plugins = Path(name), Path(name) / "plugins"
        install = [python, "-m", "pip", "install", "-q", "--no-deps", "--target", plugins]
        subprocess.run([*install, ROOT / "plugins"], check=True)
        print(run_with_plugins(plugins, python, HERE / "lerobot_camera.py", folder))
        (folder / "twin").mkdir()
        with closing(RunningTwin(TWIN, folder / "twin", 0)) as twin:
            print(
                run_with_plugins(plugins, python, HERE / "lerobot_arm.py", twin.cell_file, folder)
            )
        root = record(folder / "demo", "--env.objects", "wooden_block")
        [own] = touchgoal.Reward.of_judge("gelsight_mini")(root)
        np.save(folder / "own.npy", own.costs["fused"])
        words = HERE / "lerobot_reward.py", root, folder / "own.npy"
        print(run_with_plugins(plugins, python, *words))
        train_with_lerobot(python, plugins, folder)
        theirs = evaluate_with_lerobot(python, plugins, folder / "eval")
    here = evaluate_here()
    print(f"{'seed':>6}{'lerobot-eval':>14}{'success':>9}{'touchgoal':>11}{'success':>9}")
    for i, ((reward, success), (own, own_success)) in enumerate(zip(theirs, here, strict=True)):
        print(f"{FIRST_SEED + i:>6}{reward:>14.4f}{success!s:>9}{own:>11.4f}{own_success!s:>9}")
    same = all(abs(a[0] - b[0]) < 1e-4 and a[1] == b[1] for a, b in zip(theirs, here, strict=True))
    sys.exit(0 if same else "lerobot-eval and touchgoal differ")


if __name__ == "__main__":
    main()

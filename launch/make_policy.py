"""Make a shipped policy again, from its recordings to its weights.

Every step is a command, printed before it runs; recipe.json beside the weights lists all of them
with their seeds, episodes and hours.
"""

import os
import re
import shlex
import shutil
import time
from pathlib import Path
from typing import Annotated

from touchgoal.control.cell.config import SimulatedTask
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import RARE, Count, CountOrNone, checked_dataclass

RECIPE = "recipe.json"

_DEPLOYED = shlex.split(  # delays wider than measured on the wire: see `DeploymentConfig`
    "--env.as-deployed --env.deployment.state-delay 0 0.05 --env.deployment.picture-delay 0 0.08 "
    "--env.deployment.command-delay 0 0.04 --env.deployment.jitter 0 0.03 "
    "--env.deployment.plan-ticks 0 1 1 2"
)
# The policy is trained on the simulator's truth, so these episodes need no images.
_NO_IMAGES = ["--env.no-tactile", "--env.cameras"]
_ONLY_FOR = dict.fromkeys(("touch", "learn_touch", "wrench"), "bead-maze") | {
    "estimator": "pick-place"
}
_REGRESSION = ["--head", "regression"]
# Denoising steps: one of five. Further steps, and fresh noise at every plan, make successive plans
# disagree. On 40 validation wires a U-Net led 33 beads to the end, this perceptron 37 and, from another
# seed, 39. With longer training, the errors on validation wires rise.
_MAZE_DIFFUSION = shlex.split(
    "--head mlp --touch-noise 0.5 --sampler.loss absolute --sampler.num-train-timesteps 5 "
    "--sampler.num-inference-steps 1 --action-share 0.98"
)
_MAZE_TOUCH = "gelsight_mini_markers_mae"
_MAZE = shlex.split("--task bead-maze --env.n-wires 260 --env.start-angle 10")
_VALIDATION = shlex.split(
    "--task bead-maze --env.split validation --env.n-wires 16 --env.start-angle 10"
)


@checked_dataclass
class Config:
    """Options of make-policy."""

    task: SimulatedTask = "pick-place"
    """Task of the policy."""
    out: Path | None = None
    """Folder of the run; the policy goes to its `policy/policy`."""
    demonstrations: Count | None = None
    """Episodes of the expert; default: 240 for pick-place, 160 for the maze."""
    corrections: Count | None = None
    """Episodes in each round of corrections; default: 200 for pick-place, 80 for the maze."""
    rounds: CountOrNone | None = None
    """Rounds of DAgger: the policy acts, the expert's actions are recorded, the policy is trained again;
    default and maximum: 5 for pick-place, 3 for the maze."""
    epochs: Count | None = None
    """Passes over the data in each training; default: 16 for pick-place, 5 for the maze, 3
    for its diffusion."""
    trials: CountOrNone = 24
    """Validation episodes in which every snapshot of the last training is tried; 0 takes the last."""
    wrench: Annotated[bool, RARE] = False
    """Maze only: the baseline, a regression on the wrenches that a small network, trained on the
    simulator's truth, reads from the embedding; default: diffusion on the embedding itself."""
    touch: Annotated[Path | None, RARE] = None
    """Maze only, for new pads: run folder of a touch encoder."""
    estimator: Annotated[Path | None, RARE] = None
    """Pick-place only, for another camera: folder of a pose estimator; default: the shipped one."""
    learn_touch: bool = False
    """For new pads, maze only: first train a touch encoder without labels on the demonstrations."""
    resume: bool = False
    """Continue an interrupted run in `out`."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""


def main(config: Config) -> None:
    """Record, train, correct, train again, choose a snapshot."""
    import json

    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.provenance import portable
    from touchgoal.runtime.run_folder import open_run

    if config.learn_touch and config.touch:
        raise UserError("--learn-touch and --touch exclude each other: leave out one")
    for name, task in _ONLY_FOR.items():
        if getattr(config, name) and config.task != task:
            option = f"--{name.replace('_', '-')}"
            raise UserError(f"{option} is for {task}: leave it out, or add --task {task}")
    if config.resume and config.out is None:
        raise UserError("to go on with a run, name its folder with --out")
    steps_of = _pick_place if config.task == "pick-place" else _bead_maze
    steps_of(config, Path())  # before anything is written: too many rounds or episodes
    out = open_run(config.out, "make-policy", config, adds=config.resume)
    done = json.loads((out / RECIPE).read_text())["steps"] if (out / RECIPE).exists() else []
    for number, step in enumerate(steps_of(config, out)):
        command = shlex.join(["touchgoal", *step])
        if number < len(done) and _task_of(done[number]["command"]) == _task_of(command):
            continue
        print(f"\n{command}", flush=True)
        began = time.monotonic()
        _run(step)
        done[number:] = [{"command": command, "hours": (time.monotonic() - began) / 3600}]
        write_json(out / RECIPE, {"steps": done, "hours": sum(s["hours"] for s in done)})
    policy = out / "policy" / "policy"
    write_json(policy / RECIPE, portable(json.loads((out / RECIPE).read_text())))
    hours = sum(step["hours"] for step in done)
    print(f"\n{len(done)} steps, {hours:.1f} h on this machine: {policy / RECIPE}")
    print(f"next: touchgoal run-policy --task {config.task} --policy {policy}")


def _task_of(command: str) -> str:
    """Return a command without its number of processes, which does not change the result."""
    return re.sub(r" --workers \d+", "", command)


def _run(step: list[str]) -> None:
    from touchgoal.encoders.training.checkpoint import has_checkpoint
    from touchgoal.launch.__main__ import read_options

    folder, resume = Path(step[step.index("--out") + 1]), []
    if step[0] != "collect-demos":  # collect-demos itself skips recorded seeds
        resume = ["--resume"] * has_checkpoint(folder)
        if not resume:  # interrupted before its first epoch was finished
            shutil.rmtree(folder, ignore_errors=True)
    module, options = read_options(step[0], [*step[1:], *resume])
    module.main(options)


def _pick_place(config: Config, out: Path) -> list[list[str]]:
    """Return the steps: regression of the feedback expert, corrected in the states it reaches."""
    from touchgoal.policies.checkpoint import ESTIMATOR, SHIPPED_POLICIES

    deployed = [*_NO_IMAGES, *_DEPLOYED]
    estimator = config.estimator or SHIPPED_POLICIES["pick-place"] / ESTIMATOR
    learn = shlex.split(
        "--task pick-place --representation base_twist --position-noise 0 "
        "--arm-state commanded --observation-horizon 4 "
        f"--train.lr 1e-3 --train.epochs {config.epochs or 16} --train.snapshot-epochs 16"
    )
    learn += ["--estimator", str(estimator)]
    many = config.demonstrations or 240
    disturbed = many * 7 // 16  # demonstrations of recovery
    feedback, pushed = ["--feedback", *deployed], ["--env.disturbance", "0.02"]
    steps = _demonstrations(config, out, many, many - disturbed, feedback, feedback)
    if disturbed:
        seed = seeds.DISTURBED.first(disturbed, "--demonstrations")
        steps.append(_record(out / "train", disturbed, seed, [*feedback, *pushed], config))
    # The third round is in the plain environment, where nothing is late or estimated.
    envs = [deployed, deployed, _NO_IMAGES, deployed, deployed]
    return steps + _corrected(
        config, out, learn, _REGRESSION, _REGRESSION, envs, config.corrections or 200
    )


def _bead_maze(config: Config, out: Path) -> list[list[str]]:
    """Return the steps: diffusion of the expert that knows the wire, corrected likewise.

    The policies of the rounds are regressions; the recorded corrections are the expert's all the same.
    """
    touch = out / "touch" if config.learn_touch else config.touch
    learn = shlex.split(  # with two observed ticks the bead arrived less often on validation wires
        "--representation body_twist --arm-state commanded --train.lr 1e-3 --env.start-angle 10 "
        "--task bead-maze --observation-horizon 4 --train.snapshot-epochs 5 --refuse-unknown-touch"
    )
    learn += ["--encoder", str(touch / "encoder") if touch else _MAZE_TOUCH]
    learn += ["--touch-input", "wrench" if config.wrench else "embedding"]
    rounds = [*_REGRESSION, "--train.epochs", str(config.epochs or 5)]
    last = rounds
    if not config.wrench:
        last = [*_MAZE_DIFFUSION, "--train.epochs", str(config.epochs or 3)]
    deployed, many = [*_MAZE, *_DEPLOYED], config.demonstrations or 160
    steps = _demonstrations(config, out, many, many, [*_VALIDATION, *_DEPLOYED], deployed)
    if config.learn_touch:
        options = shlex.split("--frames 45 --mae.bottleneck --mae.epochs 12 --out")
        steps.append(["train-encoder", "mae", *_data(out), *options, str(out / "touch")])
    return steps + _corrected(
        config, out, learn, rounds, last, [deployed] * 3, config.corrections or 80
    )


def _demonstrations(
    config: Config, out: Path, many: int, train: int, validation_env: list[str], env: list[str]
) -> list[list[str]]:
    """Return the recordings of the expert: `train` episodes, and `many` / 13 for validation."""
    held_out = max(1, many // 13)
    seed = seeds.VALIDATION.first(held_out, "--demonstrations")
    return [
        _record(out / "val", held_out, seed, validation_env, config),
        _record(out / "train", train, seeds.TRAINING.first(train, "--demonstrations"), env, config),
    ]


def _corrected(
    config: Config,
    out: Path,
    options: list[str],
    learn_rounds: list[str],
    learn_last: list[str],
    envs: list[list[str]],
    episodes: int,
) -> list[list[str]]:
    """Return rounds of training and correction (DAgger), and the last training.

    Options: `options` of every training, `learn_rounds` of the rounds', `learn_last` of the last.
    """
    from touchgoal.runtime.errors import UserError

    rounds = len(envs) if config.rounds is None else config.rounds
    if rounds > len(envs):
        raise UserError(f"--rounds is {rounds}; {config.task} has at most {len(envs)}")
    learn = ["train-policy", *_data(out), "--workers", str(config.workers), *options]
    steps = []
    for k, env in enumerate(envs[:rounds]):
        folder = out / f"round-{k + 1}"
        steps.append([*learn, *learn_rounds, "--trials", "0", "--out", str(folder)])
        seed = seeds.CORRECTIONS[k].first(episodes, "--corrections")
        acts = ["--policy", str(folder / "policy"), *env]
        steps.append(_record(out / "train", episodes, seed, acts, config))
    final = [*learn, *learn_last, "--trials", str(config.trials), "--env.as-deployed"]
    return [*steps, [*final, "--out", str(out / "policy")]]


def _data(out: Path) -> list[str]:
    return ["--data", str(out / "train/episodes"), "--validation", str(out / "val/episodes")]


def _record(
    folder: Path, episodes: int, seed: int, options: list[str], config: Config
) -> list[str]:
    count = ["--episodes", str(episodes), "--seed", str(seed), "--workers", str(config.workers)]
    return ["collect-demos", *options, *count, "--out", str(folder)]

"""What `touchgoal make-policy` does."""

import json
import re
import shlex
import time
from pathlib import Path

from touchgoal.launch.__main__ import read_options
from touchgoal.launch.make_policy import Config
from touchgoal.policies.checkpoint import ESTIMATOR, SHIPPED_POLICIES
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.run_folder import open_run, write_json

RECIPE = "recipe.json"

# What lies between policy and arm, wider than what was measured on the wire: see `DeploymentConfig`.
_DEPLOYED = shlex.split(
    "--env.as-deployed --env.deployment.state-delay 0 0.05 --env.deployment.picture-delay 0 0.08 "
    "--env.deployment.command-delay 0 0.04 --env.deployment.jitter 0 0.03 "
    "--env.deployment.plan-ticks 0 1 1 2 "
    # Beyond it the expert shows how to give way.
    "--env.deployment.force-ceiling False"
)
_BLIND = [
    "--env.no-tactile",
    "--env.cameras",
]  # the policy learns on the truth of what it estimates
_MAZE_TOUCH = "gelsight_mini_markers_mae"
_MAZE = shlex.split("--task bead-maze --env.n-wires 260 --env.start-angle 10")
_VALIDATION = shlex.split(
    "--task bead-maze --env.split validation --env.n-wires 16 --env.start-angle 10"
)


def run_command(config: Config) -> None:
    """Record, train, correct, train again, choose."""
    steps = _pick_place if config.task == "pick-place" else _bead_maze
    if config.learn_touch and (config.touch or config.task == "pick-place"):
        raise UserError("--learn-touch goes with --task bead-maze and without --touch")
    if config.resume and config.out is None:
        raise UserError("to go on with a run, name its folder with --out")
    out = open_run(config.out, "make-policy", config, adds=config.resume)
    done = json.loads((out / RECIPE).read_text())["steps"] if (out / RECIPE).exists() else []
    for number, step in enumerate(steps(config, out)):
        command = shlex.join(["touchgoal", *step])
        if number < len(done) and _what(done[number]["command"]) == _what(command):
            continue
        print(f"\n{command}", flush=True)
        began = time.monotonic()
        _run(step)
        done[number:] = [{"command": command, "hours": (time.monotonic() - began) / 3600}]
        write_json(out / RECIPE, {"steps": done, "hours": sum(s["hours"] for s in done)})
    policy = out / "policy" / "policy"
    write_json(policy / RECIPE, json.loads((out / RECIPE).read_text()))
    hours = sum(step["hours"] for step in done)
    print(f"\n{len(done)} steps, {hours:.1f} h on this machine: {policy / RECIPE}")


def _what(command: str) -> str:
    """What a command does, by however many processes."""
    return re.sub(r" --workers \d+", "", command)


def _run(step: list[str]) -> None:
    """A command; where it was interrupted it goes on."""
    folder = Path(step[step.index("--out") + 1])
    # collect-demos skips what is recorded; a training has to be asked to resume
    begun = step[0] != "collect-demos" and folder.exists() and any(folder.iterdir())
    module, options = read_options(step[0], [*step[1:], *["--resume"] * begun])
    module.main(options)


def _pick_place(config: Config, out: Path) -> list[list[str]]:
    """A regression of the feedback expert, corrected where it has got to by itself."""
    wired = [*_BLIND, *_DEPLOYED]
    estimator = (
        config.touch / "estimator" if config.touch else SHIPPED_POLICIES["pick-place"] / ESTIMATOR
    )
    learn = shlex.split(
        "--task pick-place --head regression --representation base_twist --position-noise 0 "
        "--arm-state commanded --observation-horizon 4 "
        f"--train.lr 1e-3 --train.epochs {config.epochs or 16} --train.snapshot-epochs 16"
    )
    learn += ["--estimator", str(estimator)]
    many = config.demonstrations or 240
    disturbed = many * 7 // 16  # so that the expert shows how to come back
    return [
        _record(out / "val", max(1, many // 13), 120_000, ["--feedback", *wired], config),
        _record(out / "train", many - disturbed, 20_000, ["--feedback", *wired], config),
        *(
            [_record(out / "train", disturbed, 25_000,
                     ["--feedback", *wired, "--env.disturbance", "0.02"], config)]
            if disturbed else []
        ),
        # Where nothing is late or estimated it is to act, too.
        *_corrected(config, out, learn, [wired, wired, _BLIND, wired, wired], 200),
    ]  # fmt: skip


def _bead_maze(config: Config, out: Path) -> list[list[str]]:
    """A regression of the expert that sees the wire, corrected where it has got to by itself.

    It sees four ticks: with two it led the bead less often on validation wires.
    """
    touch = out / "touch" if config.learn_touch else config.touch
    encoder = str(touch / "encoder") if touch else _MAZE_TOUCH
    learn = shlex.split(
        "--representation body_twist --arm-state commanded --train.lr 1e-3 --env.start-angle 10"
    )
    learn += ["--encoder", encoder, "--task", "bead-maze"]
    learn += ["--head", "regression", "--observation-horizon", "4", "--train.snapshot-epochs", "5"]
    learn += ["--train.epochs", str(config.epochs or 5)]
    wired = [*_MAZE, *_DEPLOYED]
    many = config.demonstrations or 160
    feel = ["train-encoder", "mae", *_data(out), "--frames", "45", "--mae.bottleneck"]
    feel += ["--mae.epochs", "12", "--out", str(out / "touch")]
    return [
        _record(out / "val", max(1, many // 13), 20_000, [*_VALIDATION, *_DEPLOYED], config),
        _record(out / "train", many, 0, wired, config),
        *([feel] if config.learn_touch else []),
        *_corrected(config, out, learn, [wired] * 3, 80),
    ]


def _corrected(
    config: Config, out: Path, options: list[str], envs: list[list[str]], episodes: int
) -> list[list[str]]:
    """Rounds of learning and correcting (DAgger), so many episodes each, and the last training."""
    learn = ["train-policy", *_data(out), "--workers", str(config.workers)]
    steps = []
    for k, env in enumerate(envs[: config.rounds]):
        folder = out / f"round-{k + 1}"
        steps.append([*learn, *options, "--trials", "0", "--out", str(folder)])
        acts = ["--policy", str(folder / "policy"), *env]
        seed = 31_000 + 1000 * k
        steps.append(_record(out / "train", config.corrections or episodes, seed, acts, config))
    final = [*learn, *options, "--trials", str(config.trials), "--env.as-deployed"]
    return [*steps, [*final, "--out", str(out / "policy")]]


def _data(out: Path) -> list[str]:
    return ["--data", str(out / "train/episodes"), "--validation", str(out / "val/episodes")]


def _record(
    folder: Path, episodes: int, seed: int, options: list[str], config: Config
) -> list[str]:
    count = ["--episodes", str(episodes), "--seed", str(seed), "--workers", str(config.workers)]
    return ["collect-demos", *options, *count, "--out", str(folder)]

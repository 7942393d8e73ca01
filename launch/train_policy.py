"""Train a policy on recorded episodes, on frozen touch embeddings; choose its snapshot by trials."""

import os
import shlex
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from touchgoal.control.errors import UserError
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.policies.acting import ActorMaker
from touchgoal.policies.actions import Representation
from touchgoal.policies.diffusion import DiffusionConfig, RegressionConfig
from touchgoal.policies.maze_trials import evaluate, trials_of
from touchgoal.policies.policy import PolicyConfig
from touchgoal.policies.samplers import SamplerConfig
from touchgoal.policies.selection import Score, select
from touchgoal.policies.touch import TouchEmbedder, load_touch
from touchgoal.policies.train import TrainConfig, train
from touchgoal.policies.unet import PRESETS
from touchgoal.policies.windows import Windows, read
from touchgoal.sim_envs.bead_maze import BeadMazeConfig
from touchgoal.sim_envs.wires import choose


@dataclass(frozen=True)
class Config:
    """Options of train-policy."""

    episodes: Path
    """Set of episodes to learn from; the successful ones are."""
    validation: Path
    """Set of other episodes, on which losses are measured."""
    touch: Path | None = None
    """Folder of a frozen touch encoder (train-encoder); without one the policy does not feel."""
    out: Path | None = None
    """Folder of the run; the policy goes to its `policy/`."""
    share: float = 1.0
    """Of the episodes to learn from, the first so many."""
    head: Literal["small", "published", "tiny", "regression"] = "small"
    """Size of the diffusion's U-Net, or regression instead."""
    sampler: SamplerConfig = field(default_factory=lambda: SamplerConfig(plan_steps=4))
    """How the diffusion is trained and sampled."""
    representation: Representation = "chunk"
    """Of the actions while learning."""
    observation_horizon: int = 2
    """Ticks seen."""
    execution_horizon: int = 4
    """Ticks of a plan that are done before the next one."""
    train: TrainConfig = TrainConfig()
    """The training."""
    trials: int = 24
    """Validation wires on which every snapshot is tried; 0 keeps the last one."""
    maze: BeadMazeConfig = field(default_factory=lambda: BeadMazeConfig(split="validation"))
    """Where snapshots are tried."""
    workers: int = os.cpu_count() or 1
    """Processes that simulate."""
    resume: bool = False
    """Go on with an interrupted run in `out`."""


def main(config: Config) -> None:
    """Embed, train, choose."""
    if config.resume and config.out is None:
        raise UserError("to resume a run, name its folder with --out")
    if not 0 < config.share <= 1:
        raise UserError("share must be above 0 and at most 1")
    touch = load_touch(config.touch) if config.touch else None
    sets = EpisodeSet(config.episodes), EpisodeSet(config.validation)
    policy = _policy_config(config, sets[0], touch)
    out = open_run(config.out, "train-policy", config)
    chosen = [_successful(s) for s in sets]
    chosen[0] = chosen[0][: max(1, round(config.share * len(chosen[0])))]
    windows, validation = (
        Windows(read(s, rows, policy, touch, _cache(s, touch), config.workers), policy)
        for s, rows in zip(sets, chosen, strict=True)
    )
    print(f"{len(windows)} windows of {len(chosen[0])} episodes; {len(validation)} for validation")
    recipe = {
        "command": shlex.join(["touchgoal", *sys.argv[1:]]),
        "data": "simulated: touchgoal collect-demos",
        "episodes": len(chosen[0]),
    }
    train(policy, windows, validation, config.train, out, recipe, config.resume)
    scores = select(out, config.touch, lambda directory: _try(config, directory))
    write_json(out / "metrics.json", {"snapshots": scores})
    print(f"policy: {out / 'policy'}")


def _policy_config(
    config: Config, episodes: EpisodeSet, touch: TouchEmbedder | None
) -> PolicyConfig:
    head = RegressionConfig()
    if config.head != "regression":
        head = DiffusionConfig(PRESETS[config.head], config.sampler)
    return PolicyConfig(
        touch_dim=touch.dim if touch else 0,
        touch=touch.name if touch else "",
        representation=config.representation,
        observation_horizon=config.observation_horizon,
        execution_horizon=config.execution_horizon,
        control_hz=episodes.fps,
        head=head,
    )


def _successful(episodes: EpisodeSet) -> list[int]:
    return [i for i in range(len(episodes)) if episodes.meta(i).get("success", True)]


def _cache(episodes: EpisodeSet, touch: TouchEmbedder | None) -> Path:
    """Beside the episodes, so that every training on them shares it."""
    name = touch.name.replace("/", "_") if touch else "none"
    return episodes.root.parent / "embeddings" / name


def _try(config: Config, directory: Path) -> Score:
    if config.trials == 0:
        return 0.0, 0.0
    maze = config.maze
    if not config.touch:
        maze = replace(maze, tactile=False)
    wires = choose(maze.split, config.trials, maze.families)
    trials = evaluate(maze, ActorMaker(directory), trials_of(wires, 2_000_000), config.workers)
    success = float(np.mean([t.success for t in trials]))
    return success, float(np.mean([t.progress for t in trials]))

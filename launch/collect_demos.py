"""Record expert episodes of a task, or failures to order, as a LeRobot-v3 data set."""

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from touchgoal.control.errors import UserError
from touchgoal.episodes.recording import EpisodeSpec, Roles, collect, expert_alone
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.policies import checkpoint
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.dagger import DaggerRoles
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig
from touchgoal.sim_envs.experts.pick_place import Outcome
from touchgoal.sim_envs.scene.objects import CATALOGUE, find
from touchgoal.sim_envs.scene.wires import choose


@dataclass(frozen=True)
class Config:
    """Options of collect-demos."""

    task: Literal["pick-place", "bead-maze"] = "pick-place"
    """What is demonstrated."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`, after those already there."""
    episodes: int = 10
    """How many of each outcome."""
    outcomes: tuple[Outcome, ...] = ("success",)
    """What the expert shall do: succeed, or (pick-place) fail in one of four ways."""
    objects: tuple[str, ...] = ()
    """pick-place: catalogue names, taken in turn; default: all."""
    feedback: bool = False
    """pick-place: show it by a law of the present state, from which a policy learns better than from
    planned paths."""
    policy: Path | None = None
    """A policy that acts in the expert's place; what the expert would have done is recorded (DAgger)."""
    seed: int = 0
    """Of the first episode; each further one adds one."""
    workers: int = os.cpu_count() or 1
    """Processes that simulate."""
    env: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    """Options of pick-place."""
    maze: BeadMazeConfig = field(default_factory=lambda: BeadMazeConfig(disturbance=0.004))
    """Options of bead-maze; its wires are taken in turn. The disturbance shows recoveries."""


def main(config: Config) -> None:
    """Record the episodes and say what came of them."""
    task, options = _choose(config)
    demonstrations = [
        EpisodeSpec(config.seed + i, outcome, options[i % len(options)])
        for i, outcome in enumerate(config.outcomes * config.episodes)
    ]
    roles = _roles(config)
    out = open_run(config.out, "collect-demos", config)
    metas = collect(out / "episodes", task, demonstrations, config.workers, roles)
    outcomes = Counter(str(meta["outcome"]) for meta in metas)
    write_json(out / "metrics.json", {"outcomes": outcomes, "episodes": metas})
    print(f"{len(metas)} episodes in {out / 'episodes'}")
    for outcome, count in outcomes.items():
        print(f"  {outcome:<14}{count}")
    if config.policy:
        rate = SuccessRate(sum(bool(meta["success"]) for meta in metas), len(metas))
        print(f"the policy succeeded in {rate}")


def _choose(config: Config) -> tuple[TaskConfig, list[dict[str, Any]]]:
    """The task's own config, and the reset options that the episodes take in turn."""
    if config.task == "bead-maze":
        maze = config.maze
        return maze, [{"wire": w.name} for w in choose(maze.split, maze.n_wires, maze.families)]
    names = [find(name).name for name in config.objects] or list(CATALOGUE)
    return config.env, [{"object": name} for name in names]


def _roles(config: Config) -> Roles:
    if not config.feedback and config.policy is None:
        return expert_alone
    if config.outcomes != ("success",) or config.env.release:
        raise UserError("no expert to be asked in any state fails, or lets go: leave these options")
    if config.policy:
        checkpoint.load(config.policy)  # what is wrong with it is said before anything is written
    return DaggerRoles(config.policy)

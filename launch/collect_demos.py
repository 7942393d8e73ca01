"""Record an expert's episodes of a task, or failures on purpose, as a LeRobot-v3 data set."""

import os
import shlex
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from touchgoal.control.errors import UserError
from touchgoal.episodes.recording import EpisodeSpec, Roles, collect, expert_alone
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.policies.by_name import choose_policy, env_config_for
from touchgoal.policies.checkpoint import SavedPolicy, load
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.dagger import DaggerRoles
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig
from touchgoal.sim_envs.experts.pick_place import Outcome
from touchgoal.sim_envs.scene.objects import CATALOGUE, find


@dataclass(frozen=True)
class Config:
    """Options of collect-demos."""

    task: Literal["pick-place", "bead-maze"] = "pick-place"
    """What is demonstrated."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`, after those already there."""
    episodes: int = 10
    """Number of episodes of each outcome."""
    outcomes: tuple[Outcome, ...] = ("success",)
    """What the expert shall do: succeed, or (pick-place) fail in one of four ways."""
    objects: tuple[str, ...] = ()
    """pick-place: catalogue names, taken in turn; default: all."""
    feedback: bool = False
    """pick-place: the expert decides anew at every tick instead of following a planned path; a policy
    learns better from that."""
    policy: str | None = None
    """A policy that acts in the expert's place, while what the expert would have done is recorded
    (DAgger): named as for run-policy."""
    seed: int = 0
    """Random seed of the first episode; each further one adds one."""
    resume: bool = False
    """Go on with an interrupted recording in `out`: leave out the seeds that it holds already."""
    workers: int = os.cpu_count() or 1
    """Processes that simulate."""
    env: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    """Options of pick-place."""
    maze: BeadMazeConfig = field(default_factory=lambda: BeadMazeConfig(disturbance=0.004))
    """Options of bead-maze; its wires are taken in turn. The disturbance shows recoveries."""


def main(config: Config) -> None:
    """Record the episodes and say what came of them."""
    task, options = _task(config)
    roles = _roles(config, task)
    specs = specs_of(config, options)
    if config.resume:
        specs = _missing(config, specs)
    out = open_run(config.out, "collect-demos", config, adds=True)
    try:
        metas = collect(out / "episodes", task, specs, config.workers, roles)
    except KeyboardInterrupt:
        _stopped(out, config)
        sys.exit(130)
    outcomes = Counter(str(meta["outcome"]) for meta in metas)
    write_json(out / "metrics.json", {"outcomes": outcomes, "episodes": metas})
    print(f"{len(metas)} episodes in {out / 'episodes'}")
    for outcome, count in outcomes.items():
        print(f"  {outcome:<14}{count}")
    if config.policy:
        rate = SuccessRate(sum(bool(meta["success"]) for meta in metas), len(metas))
        print(f"the policy succeeded in {rate}")


def specs_of(config: Config, options: list[dict[str, Any]]) -> list[EpisodeSpec]:
    """The episodes to record: with each object (or wire) in turn, every outcome once."""
    kinds = config.outcomes
    return [
        EpisodeSpec(config.seed + i, kinds[i % len(kinds)], options[i // len(kinds) % len(options)])
        for i in range(len(kinds) * config.episodes)
    ]


def _missing(config: Config, specs: list[EpisodeSpec]) -> list[EpisodeSpec]:
    """The episodes that the set in `out` does not hold yet."""
    if config.out is None:
        raise UserError("to go on with a recording, name its folder with --out")
    if not (config.out / "episodes").is_dir():
        return specs
    kept = EpisodeSet(config.out / "episodes")
    seeds = [kept.meta(i)["seed"] for i in range(len(kept))]
    missing = [spec for spec in specs if spec.seed not in seeds]
    if not missing:
        raise UserError(f"all {len(specs)} episodes are in {config.out / 'episodes'} already")
    return missing


def _stopped(out: Path, config: Config) -> None:
    """Say after Ctrl-C what is kept, and how to go on."""
    root = out / "episodes"
    if not root.exists():
        print("\nstopped before the first episode was recorded: nothing to keep")
        return
    kept = len(EpisodeSet(root))
    print(f"\nstopped: {kept} episodes are kept in {root}, whole and sound. To go on:")
    rest = [] if config.out else ["--out", str(out)]
    rest += [] if config.resume else ["--resume"]
    print("  " + shlex.join(["touchgoal", *sys.argv[1:], *rest]))


def _task(config: Config) -> tuple[TaskConfig, list[dict[str, Any]]]:
    """The task's own config, and the reset options that the episodes take in turn."""
    if config.task == "bead-maze":
        return config.maze, [{"wire": wire.name} for wire in config.maze.chosen_wires()]
    names = [find(name).name for name in config.objects or config.env.objects] or list(CATALOGUE)
    return config.env, [{"object": name} for name in names]


def _roles(config: Config, task: TaskConfig) -> Roles:
    """Who acts and who answers; UserError for a policy that cannot act in the task."""
    if not config.feedback and config.policy is None:
        return expert_alone
    if config.outcomes != ("success",) or config.env.release:
        raise UserError(
            "an expert that is asked at every tick neither fails on purpose nor lets go: leave out "
            "--outcomes, --env.release, or --feedback and --policy"
        )
    if config.policy is None or config.policy == "expert":
        return DaggerRoles()
    policy = choose_policy(config.policy, task)  # wrong ones are refused before anything is written
    needed = env_config_for(policy, task)
    knows_truth = isinstance(policy, SavedPolicy) and load(policy.directory).config.estimated
    if not knows_truth:
        missing = [f"the {name} camera" for name in needed.cameras if name not in task.cameras]
        missing += ["the fingertips"] * (needed.tactile and not task.tactile)
        if missing:
            raise UserError(
                f"the policy looks at {missing[0]}: record that too (--env.cameras, --env.tactile)"
            )
    return DaggerRoles(policy)

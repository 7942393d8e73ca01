"""Run a policy in a task and say how often it succeeds, with a 95 % Wilson interval."""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from touchgoal.control.errors import UserError
from touchgoal.episodes.media import write_video
from touchgoal.episodes.recording import Actor, EpisodeSpec, record_with_film
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.policies.checkpoint import SHIPPED, SavedPolicy
from touchgoal.policies.evaluation import bead_maze as maze_trials
from touchgoal.policies.evaluation import pick_place as rollout
from touchgoal.policies.evaluation.bead_maze import MazeTrial
from touchgoal.policies.evaluation.pick_place import Trial
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.follower import WireFollower
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig
from touchgoal.sim_envs.experts.bead_maze import BeadMazeExpert
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.scene.objects import CATALOGUE, SHAPES, find
from touchgoal.sim_envs.scene.wires import FAMILIES, choose
from touchgoal.sim_envs.tasks import make_env

Task = TypeVar("Task", PickPlaceConfig, BeadMazeConfig)


@dataclass(frozen=True)
class Config:
    """Options of run-policy."""

    task: Literal["pick-place", "bead-maze"] = "pick-place"
    """Where to run it."""
    policy: str = "shipped"
    """Which policy: shipped, trained by `make maze-policy` or `make pick-place-policy`; a folder that
    train-policy made; expert, which sees the simulator's state; or (bead-maze) follower, the
    classical one, which feels the force on the hand."""
    latency: int = 0
    """Ticks that a learned policy's plans come late, as where they take longer than half a tick."""
    out: Path | None = None
    """Folder of the run."""
    episodes: int = 20
    """How many; objects are taken from the catalogue in turn, wires one each."""
    objects: tuple[str, ...] = ()
    """pick-place: catalogue names; default: all."""
    seed: int = 1_000_000
    """Of the first episode; each further one adds one."""
    workers: int = os.cpu_count() or 1
    """Processes that simulate."""
    video: bool = True
    """Film the worst, the median and the best episode."""
    env: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    """Options of pick-place; what the policy does not look at is not rendered."""
    maze: BeadMazeConfig = field(default_factory=lambda: BeadMazeConfig(split="validation"))
    """Options of bead-maze; what the policy does not look at is not rendered."""


def main(config: Config) -> None:
    """Run the episodes, print the table, film three of them."""
    if config.episodes < 1:
        raise UserError("nothing to run: ask for at least one episode")
    if config.task == "bead-maze":
        _run_maze(config)
    else:
        _run_pick_place(config)


def _run_pick_place(config: Config) -> None:
    names = [find(name).name for name in config.objects] or list(CATALOGUE)
    jobs = rollout.demonstrations_of(names, config.episodes, config.seed)
    if config.policy == "follower":
        raise UserError("the follower is for the bead maze; add: --task bead-maze")
    policy = PickPlaceExpert if config.policy == "expert" else _learned(config)
    env = _observe(config.env, policy)
    out = open_run(config.out, "run-policy", config)
    trials = rollout.evaluate(env, policy, jobs, config.workers)
    ranked = sorted(range(len(trials)), key=lambda i: (trials[i].progress, -trials[i].error))
    _report(out, trials, table(trials))
    if config.video:
        _film(out, env, [jobs[i] for i in ranked], policy)


def _run_maze(config: Config) -> None:
    wires = choose(config.maze.split, config.episodes, config.maze.families)
    jobs = maze_trials.trials_of(wires, config.seed)
    classical = {"expert": BeadMazeExpert, "follower": _follower}
    policy = classical.get(config.policy) or _learned(config)
    env = _observe(config.maze, policy)
    out = open_run(config.out, "run-policy", config)
    trials = maze_trials.evaluate(env, policy, jobs, config.workers)
    ranked = sorted(range(len(trials)), key=lambda i: (trials[i].progress, -trials[i].peak_force))
    _report(out, trials, maze_table(trials))
    if config.video:
        _film(out, env, [jobs[i] for i in ranked], policy)


def _follower(env: BeadMaze) -> WireFollower:
    return WireFollower(env.config.control_hz)


def _learned(config: Config) -> SavedPolicy:
    """A policy on disk; UserError if it does not fit the task, before anything is simulated."""
    task = config.maze if config.task == "bead-maze" else config.env
    directory = SHIPPED[config.task] if config.policy == "shipped" else Path(config.policy)
    return SavedPolicy(directory, latency=config.latency).check_task(task)


def _observe(task: Task, policy: object) -> Task:
    """The task with the pictures that the policy looks at, and no others."""
    if isinstance(policy, SavedPolicy):
        return policy.env_config(task)
    return replace(task, tactile=False, cameras=())


def _report(out: Path, trials: list[Trial] | list[MazeTrial], printed: str) -> None:
    write_json(out / "metrics.json", summary(trials))
    print(f"{printed}\nall trials: {out / 'metrics.json'}")


def _film(
    out: Path, task: TaskConfig, ranked: list[EpisodeSpec], policy: Callable[[Any], Actor]
) -> None:
    """Films the worst episode, the median and the best; `ranked` has the worst first."""
    places = {"worst": 0, "median": len(ranked) // 2, "best": len(ranked) - 1}
    env = make_env(replace(task, tactile=True))
    for name in list(places)[: len(ranked)]:
        job = ranked[places[name]]
        _, frames = record_with_film(env, job, policy)
        write_video(out / f"{name}.mp4", frames, task.control_hz)
        print(f"{name} episode (seed {job.seed}): {out / f'{name}.mp4'}")
    env.close()


def summary(trials: list[Trial] | list[MazeTrial]) -> dict:
    """What metrics.json holds."""
    rate = SuccessRate(sum(t.success for t in trials), len(trials))
    return {
        "successes": rate.successes,
        "trials": rate.trials,
        "wilson_95": rate.interval,
        "episodes": [asdict(t) for t in trials],
    }


def table(trials: list[Trial]) -> str:
    """Success by shape and in all; mass and force ranges met."""
    lines = [f"{'shape':<10}{'success [95 % Wilson]':<26}{'placing error mm':>17}"]
    for shape in (*SHAPES, "all"):
        some = [t for t in trials if shape in (t.shape, "all")]
        if some:
            rate = SuccessRate(sum(t.success for t in some), len(some))
            error = 1e3 * sum(t.error for t in some) / len(some)
            lines.append(f"{shape:<10}{rate!s:<26}{error:>17.1f}")
    masses, forces = [t.mass for t in trials], [t.grasp_force for t in trials]
    loads = [t.peak_load for t in trials if t.success] or [0.0]
    lines.append(
        f"masses {1e3 * min(masses):.0f} to {1e3 * max(masses):.0f} g, "
        f"grasp forces {min(forces):.1f} to {max(forces):.1f} N; "
        f"successes loaded the hand with at most {np.median(loads):.1f} N (median), {max(loads):.1f} N"
    )
    return "\n".join(lines)


def maze_table(trials: list[MazeTrial]) -> str:
    """Success, completed fraction and forces by family of wires and in all; what went wrong."""
    lines = [
        f"{'family':<12}{'success [95 % Wilson]':<26}{'completed':>10}"
        f"{'mean force N':>14}{'peak force N':>14}{'seconds':>9}"
    ]
    for family in (*FAMILIES, "all"):
        some = [t for t in trials if family in (t.family, "all")]
        if some:
            rate = SuccessRate(sum(t.success for t in some), len(some))
            lines.append(
                f"{family:<12}{rate!s:<26}{np.mean([t.progress for t in some]):>10.0%}"
                f"{np.mean([t.mean_force for t in some]):>14.1f}"
                f"{max(t.peak_force for t in some):>14.1f}"
                f"{np.mean([t.seconds for t in some]):>9.1f}"
            )
    failures = Counter(t.failure for t in trials if t.failure)
    lines.append("failures: " + (", ".join(f"{k} {n}" for k, n in failures.items()) or "none"))
    return "\n".join(lines)

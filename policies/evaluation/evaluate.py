"""How often does a policy succeed? Many episodes of a task, judged by the simulator.

From Python::

    result = evaluate("shipped", "bead-maze", episodes=20)
    print(result.rate)  # 19/20 [0.76, 0.99]
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.deployment.user_policy import UserPolicy, preferred_env_config
from touchgoal.episodes.recording import EpisodeSpec, one_core_workers, run
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.by_name import (
    PolicyMaker,
    choose_policy,
    env_config_for,
)
from touchgoal.policies.checkpoint import SavedPolicy
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import TASKS, BeadMazeConfig, TaskConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.objects import CATALOGUE
from touchgoal.sim_envs.tasks import make_env


@dataclass(frozen=True)
class Trial:
    """One episode's result.

    Attributes:
        seed: of the episode.
        success: as the task defines it.
        progress: the greatest reached, in [0, 1].
        failure: what ended it: drop, jam, over_force, time (is up), or nothing.
        peak_force: greatest external force on the hand, N.
        mean_force: its mean, N.
        peak_pad_force: greatest normal force on a fingertip, N.
        goal_distance: of the object from its goal at the end, m; None where the task has no goal
            position.
        seconds: length.
        episode: what distinguishes it: the object, its mass, or the wire.
    """

    seed: int
    success: bool
    progress: float
    failure: str
    peak_force: float
    mean_force: float
    peak_pad_force: float
    goal_distance: float | None
    seconds: float
    episode: dict[str, Any]


@dataclass(frozen=True)
class Evaluation:
    """How often a policy succeeded, and every trial."""

    trials: tuple[Trial, ...]

    @property
    def rate(self) -> SuccessRate:
        """Successes among the trials, with a 95 % interval."""
        return SuccessRate(sum(t.success for t in self.trials), len(self.trials))

    @property
    def progress(self) -> float:
        """Mean progress, in [0, 1]."""
        return float(np.mean([t.progress for t in self.trials]))

    def __str__(self) -> str:
        """Such as 49/50 [0.90, 1.00]."""
        return str(self.rate)


def evaluate(
    policy: str | Path | LearnedPolicy | UserPolicy | type,
    task: str | TaskConfig = "pick-place",
    *,
    episodes: int = 20,
    seed: int = seeds.EVALUATION.start,
    workers: int = 1,
) -> Evaluation:
    """Runs a policy in a task and says how often it succeeds.

    Args:
        policy: a name or folder as for `--policy`, what `load_policy` returned, or a policy of
            one's own (see `control/deployment/user_policy.py`): its class, or an object of it.
        task: "pick-place", "bead-maze" (validation wires), or the config of either.
        episodes: how many; objects are taken in turn, wires one each.
        seed: of the first episode; each further one adds one.
        workers: processes that simulate; with more than one, start from a script that guards its
            main part by `if __name__ == "__main__"`.

    Raises:
        UserError: no such task or policy, or one that cannot act in the other.
    """
    if episodes < 1 or workers < 1:
        raise UserError("evaluate needs at least one episode and one worker")
    config = _task_config(task)
    if isinstance(policy, LearnedPolicy) and policy.directory is not None:
        maker: PolicyMaker = SavedPolicy(policy.directory, policy.plan_ticks)
    elif isinstance(policy, str | Path):
        maker = choose_policy(policy, config)
    else:
        maker = _UserPolicyMaker(policy)
    config = env_config_for(maker, config)
    specs = trial_specs(config, episodes, seed)
    return Evaluation(tuple(run_trials(config, maker, specs, workers)))


def trial_specs(config: TaskConfig, count: int, seed: int) -> list[EpisodeSpec]:
    """So many trials: objects in turn, wires one each; the seeds, from `seed` on, do the rest."""
    if isinstance(config, BeadMazeConfig):
        wires = config.chosen_wires(count)
        return [EpisodeSpec(seed + i, options={"wire": w.name}) for i, w in enumerate(wires)]
    names = config.objects or list(CATALOGUE)
    return [EpisodeSpec(seed + i, options={"object": names[i % len(names)]}) for i in range(count)]


def run_trials(
    config: TaskConfig, policy: PolicyMaker, specs: Sequence[EpisodeSpec], workers: int
) -> Iterator[Trial]:
    """Runs what `policy` makes in each episode; yields the trials in their order as they end.

    Args:
        config: of the task.
        policy: makes an actor for an episode; must pickle if there are several workers.
        specs: the episodes.
        workers: processes; one: in this process.
    """
    if workers == 1:
        for spec in track(specs, "trials", "episode"):
            yield run_trial(config, policy, spec)
        return
    n = len(specs)
    with one_core_workers(min(workers, n)) as pool:
        results = pool.map(run_trial, [config] * n, [policy] * n, specs)
        yield from track(results, "trials", "episode", total=n)


def run_trial(config: TaskConfig, policy: PolicyMaker, spec: EpisodeSpec) -> Trial:
    """One episode."""
    env = make_env(config)
    try:
        observation, info = env.reset(seed=spec.seed, options=spec.options)
        keys = (ft.WRENCH, ft.TRUTH_PAD_WRENCH, ft.TRUTH_PROGRESS)
        rows, last = [], info
        for last in run(env, policy(env), observation, info):
            rows.append([last[key] for key in keys])  # pictures would fill the memory
        wrench, pads, progress = (np.stack(column) for column in zip(*rows, strict=True))
        force = np.linalg.norm(wrench[:, :3], axis=1)
        goal = env.goal if isinstance(env, PickPlace) else None
        away = None if goal is None else np.linalg.norm(last[ft.TRUTH_OBJECT_POSE][:2] - goal)
        return Trial(
            seed=spec.seed,
            success=bool(last[ft.TRUTH_SUCCESS][0]),
            progress=float(progress.max()),
            failure="" if last[ft.TRUTH_SUCCESS][0] else (env.failures() or ["time"])[0],
            peak_force=float(force.max()),
            mean_force=float(force.mean()),
            peak_pad_force=float(np.abs(pads[:, [2, 8]]).max()),
            goal_distance=None if away is None else float(away),
            seconds=(len(rows) - 1) / config.control_hz,
            episode=env.episode_info(),
        )
    finally:
        env.close()


def _task_config(task: str | TaskConfig) -> TaskConfig:
    if not isinstance(task, str):
        return task
    if task not in TASKS:
        raise UserError(f"there is no task {task!r}: choose from {', '.join(TASKS)}")
    return BeadMazeConfig(split="validation") if task == "bead-maze" else TASKS[task]()


@dataclass(frozen=True)
class _UserPolicyMaker:
    """Makes actors of a class or an object of one's own."""

    policy: Any

    def __call__(self, env: object = None) -> UserPolicy:
        policy = self._object()
        policy.reset()
        return policy

    def env_config(self, config: TaskConfig) -> TaskConfig:
        return preferred_env_config(self._object(), config)

    def _object(self) -> UserPolicy:
        return self.policy() if isinstance(self.policy, type) else self.policy

"""Success rate of a policy over many episodes of a task, judged by the simulator."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium.spaces import Box

from touchgoal.control import features as ft
from touchgoal.control.interfaces import Actor, Policy
from touchgoal.control.tactile.light_gain import LightWatch
from touchgoal.episodes.recording import OUTCOME_SECONDS, EpisodeSpec, run
from touchgoal.policies.by_name import prepare_policy
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import RefusedError, UserError, unknown_name
from touchgoal.runtime.parallel.parallel_map import Workers, parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import ENVS, TaskConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.tasks import make_env

REFUSED = "refused"  # failure of an episode in which the policy would not act
GAVE_UP = "gave up"  # of one in which it held nothing again and again
FALSELY_DONE = "falsely done"  # of one that it ended as done
_TOLERANCE = 1e-3  # rad or m by which an action may exceed a limit before it counts as clamped
_LIGHT_TICKS = 10  # from one look at the fingertips' light to the next


@dataclass(frozen=True)
class Trial:
    """Result of one episode.

    Attributes:
        seed: random seed of the episode.
        success: as the task defines it.
        progress: the greatest reached, in [0, 1].
        failure: what ended it, such as drop, over_force, time, refused or falsely done; "" after a success.
        peak_force: greatest external force on the hand, N.
        mean_force: its mean, N.
        peak_pad_force: greatest normal force on a fingertip, N.
        goal_distance: of the object from its goal at the end, m; None where the task has no goal
            position.
        seconds: length.
        clamped: share of the ticks whose action was beyond the arm's or the gripper's limits.
        light_change: largest change of a fingertip's light since the first image, as a share.
        episode: what distinguishes it, such as the object, its mass, or the wire.
        judged: verdict of a judge; "" without one.
        late: s from the first success to the policy's word that it is done; None without both.
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
    clamped: float
    light_change: float
    episode: dict[str, Any]
    judged: str = ""
    late: float | None = None


@dataclass(frozen=True)
class Evaluation:
    """Trials of a policy and their summary."""

    trials: tuple[Trial, ...]

    @property
    def rate(self) -> SuccessRate:
        """Success rate, with a 95 % interval."""
        return SuccessRate(sum(t.success for t in self.trials), len(self.trials))

    @property
    def progress(self) -> float:
        """Mean progress, in [0, 1]."""
        return float(np.mean([t.progress for t in self.trials]))

    def __str__(self) -> str:
        return str(self.rate)


def evaluate(
    policy: str | Path | Policy | type,
    task: str | TaskConfig = "pick-place",
    *,
    episodes: int = 20,
    seed: int = seeds.EVALUATION.start,
    workers: int = 1,
    target: str | None = None,
) -> Evaluation:
    """Run a policy in a task and return how often it succeeds.

    Args:
        policy: a name or folder as for `--policy`, what `load_policy` returned, or a user's own
            policy (see `control/deployment/user_policy.py`): its class, or an object of it.
        task: "pick-place", "bead-maze" (validation wires), "fragile-carry", or a config of one.
        episodes: number of episodes; objects are taken in turn, wires one each.
        seed: of the first episode; each further one adds one.
        workers: processes that simulate; with more than one, start from a script that guards its
            main part by `if __name__ == "__main__"`.
        target: the object to pick up where several lie on the table, in words; "{object}" in it is
            the name of each episode's.

    Raises:
        UserError: no such task or policy, or the policy cannot act in the task.
    """
    if episodes < 1 or workers < 1:
        raise UserError("evaluate needs at least one episode and one worker")
    if isinstance(task, str):
        if task not in ENVS:
            raise unknown_name("task", task, ENVS)
        task = ENVS[task]
    maker, config = prepare_policy(policy, task, target)
    return Evaluation(
        tuple(run_trials(config, maker, trial_specs(config, episodes, seed), workers))
    )


def trial_specs(config: TaskConfig, count: int, seed: int) -> list[EpisodeSpec]:
    """Return `count` episodes: objects in turn, wires one each; seeds count up from `seed`."""
    options = config.reset_options(count)
    return [EpisodeSpec(seed + i, options=options[i % len(options)]) for i in range(count)]


def run_trials(
    config: TaskConfig,
    policy: Callable[[Any], Actor],
    specs: Sequence[EpisodeSpec],
    workers: Workers,
    judge: Callable[[Any], Any] | None = None,
) -> Iterator[Trial]:
    """Run a policy in each episode; yield the trials in order as they end.

    With one worker all runs in this process; for several `policy` and `judge` (as `RunJudge`), which make
    one for an environment, must pickle.
    """
    if workers == 1:
        for spec in track(specs, "trials", "episode"):
            yield run_trial(config, policy, spec, judge)
        return
    with parallel_map(partial(run_trial, config, policy, judge=judge), specs, workers) as trials:
        yield from track(trials, "trials", "episode", total=len(specs))


def run_trial(
    config: TaskConfig,
    policy: Callable[[Any], Actor],
    spec: EpisodeSpec,
    judge: Callable[[Any], Any] | None = None,
) -> Trial:
    """Run one episode; a judge's success ends it, too."""
    env = make_env(config)
    try:
        observation, info = env.reset(seed=spec.seed, options=spec.options)
        keys = (ft.WRENCH, ft.TRUTH_PAD_WRENCH, ft.TRUTH_PROGRESS, ft.ACTION, ft.TRUTH_SUCCESS)
        rows, light, failed, late = [], LightWatch(), [], None
        judging = judge(env) if judge else None
        last = {**observation, ft.ACTION: np.zeros(env.action_space.shape or ()), **info}
        try:
            actor = policy(env)
            for last in run(env, actor, observation, info):
                if len(rows) % _LIGHT_TICKS == 0:
                    light.update(last)
                rows.append([last[key] for key in keys])  # images would fill the memory
                if judging and judging.ended(last):
                    break
            failed = [GAVE_UP] * bool(actor.given_up) + [FALSELY_DONE] * actor.done
            if actor.done and any(right := [bool(row[-1][0]) for row in rows]):
                since_first = (len(rows) - 1 - right.index(True)) / config.control_hz
                late = since_first - OUTCOME_SECONDS
        except RefusedError:
            rows, failed = [*rows, [last[key] for key in keys]], [REFUSED]
        wrench, pads, progress, actions, _ = map(np.stack, zip(*rows, strict=True))
        force = np.linalg.norm(wrench[:, :3], axis=1)
        goal = env.goal if isinstance(env, PickPlace) else None
        away = None if goal is None else np.linalg.norm(last[ft.TRUTH_OBJECT_POSE][:2] - goal)
        limits = cast(Box, env.action_space)
        low, high = limits.low - _TOLERANCE, limits.high + _TOLERANCE
        return Trial(
            seed=spec.seed,
            success=bool(last[ft.TRUTH_SUCCESS][0]),
            progress=float(progress.max()),
            failure="" if last[ft.TRUTH_SUCCESS][0] else [*failed, *env.failures(), "time"][0],
            peak_force=float(force.max()),
            mean_force=float(force.mean()),
            peak_pad_force=float(np.abs(pads[:, [2, 8]]).max()),
            goal_distance=None if away is None else float(away),
            seconds=(len(rows) - 1) / config.control_hz,
            clamped=float(np.any((actions < low) | (actions > high), axis=1)[:-1].sum())
            / max(len(rows) - 1, 1),
            light_change=light.change,
            episode=env.episode_info(),
            judged=judging.verdict() if judging else "",
            late=late,
        )
    finally:
        env.close()

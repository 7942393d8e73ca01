"""Whether a policy says when it is done: the simulator's verdict is hidden, the run ends when the policy says so.

It rests for a second then, and the simulator tells the outcome. Also with the object taken away or knocked out of
the hand, where it must mend the task, or not call it done.
"""

from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, get_args

import numpy as np

from benchmarks.deployment.robustness import CHANGES
from benchmarks.deployment.trials import UNCHANGED, TrialOptions
from touchgoal.control import features as ft
from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.episodes.recording import run as run_episode
from touchgoal.policies.by_name import prepare_policy
from touchgoal.policies.evaluation.evaluate import trial_specs
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.runtime.errors import RefusedError
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import ENVS, BeadMazeConfig, TaskConfig, TaskName
from touchgoal.sim_envs.tasks import make_env

_INTERFERENCES = "object taken away", "object knocked out of the hand"
_SOON = 2.0  # s


@checked_dataclass
class Config(TrialOptions):
    """Options of benchmark policy-ends."""

    tasks: tuple[TaskName, ...] = get_args(TaskName)
    """Tasks; the maze is on test wires, all are as deployed."""


@dataclass(frozen=True)
class End:
    """How an episode ended."""

    seed: int
    said: bool  # whether the policy said that it is done
    success: bool  # at the end, by the simulator
    late: float | None  # s from the first success to the policy's word; None without both
    failures: list[str]


def run(config: Config) -> dict[str, Any]:
    """Run every task, and pick-and-place with what happens to its object; return the table."""
    lines = [
        f"{'':<46}{'done, and so it is':<24}{'falsely':>8}{'not said':>9}{'failed':>7}  within 2 s"
    ]
    rows = []
    for task in config.tasks:
        for what, env in _environments(task).items():
            maker, env = prepare_policy(config.policy, env)
            specs = trial_specs(env, config.episodes, config.seed)
            job = partial(_end, replace(env, ends_by_success=False), maker)
            with parallel_map(job, specs, config.workers) as found:
                ends = list(track(found, "running", "episode", total=len(specs)))
            right = [end for end in ends if end.said and end.success]
            falsely = sum(end.said and not end.success for end in ends)
            missed = sum(end.success and not end.said for end in ends)
            soon = SuccessRate(sum(abs(end.late or 0.0) <= _SOON for end in right), len(right))
            rate = SuccessRate(len(right), len(ends))
            failed = len(ends) - len(right) - falsely - missed
            lines.append(
                f"{f'{task}, {what}':<46}{rate!s:<24}{falsely:>8}{missed:>9}{failed:>7}  {soon if right else ''}"
            )
            rows.append({"what": f"{task}, {what}", "ends": [asdict(end) for end in ends]})
    return {"table": "\n".join(lines), "rows": rows}


def _environments(task: TaskName) -> dict[str, TaskConfig]:
    base = replace(ENVS[task], as_deployed=True)
    if isinstance(base, BeadMazeConfig):
        base = replace(base, split="test", start_angle=10.0)
    changes = {name: CHANGES[task][name] for name in _INTERFERENCES} if task == "pick-place" else {}
    return {UNCHANGED: base, **{name: replace(base, **c) for name, c in changes.items()}}


def _end(config: TaskConfig, policy: Any, spec: EpisodeSpec) -> End:
    env = make_env(config)
    succeeded: list[bool] = []
    observation, info = env.reset(seed=spec.seed, options=spec.options)
    try:
        actor = policy(env)
        for tick in run_episode(env, actor, observation, info):
            succeeded.append(bool(tick[ft.TRUTH_SUCCESS][0]))
        failures = [actor.given_up] if actor.given_up else env.failures()
        said = actor.done
    except RefusedError as error:
        said, failures = False, [str(error)]
    finally:
        env.close()
    rested = config.control_hz  # ticks after the policy's word
    late = None
    if said and any(succeeded):
        late = (len(succeeded) - 1 - rested - int(np.argmax(succeeded))) / config.control_hz
    return End(spec.seed, said, bool(succeeded and succeeded[-1]), late, failures)

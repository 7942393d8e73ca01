"""Whether a policy's success depends on touch: its fingertips see what they should not.

Each episode is run unchanged and with the tactile images removed (the first, untouched ones all along), shuffled
(those of the unchanged run in another order), taken tick by tick from the run in the next scene or on the next
wire (its last one repeated if that is shorter), or from the other fingertip. A policy that does as well without
its touch does not use it.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, get_args

import numpy as np

from benchmarks.deployment.trials import (
    TABLE_HEAD,
    UNCHANGED,
    TrialOptions,
    deployed,
    table_row,
)
from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.policies.by_name import prepare_policy
from touchgoal.policies.evaluation.evaluate import Evaluation, Trial, run_trial, trial_specs
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import TaskConfig, TaskName

Change = Callable[[Observation, int], Observation]
"""Returns the tactile images that a policy sees at a tick, from those that are there."""


@checked_dataclass
class Config(TrialOptions):
    """Options of benchmark audit."""

    tasks: tuple[TaskName, ...] = get_args(TaskName)
    """Tasks; all that a twin serves are as deployed."""


@dataclass
class _Watched(Actor):
    """A policy whose tactile images are kept, and changed before it sees them."""

    policy: Actor
    change: Change
    seen: list[Observation] = field(default_factory=list)

    def act(self, observation: Observation) -> np.ndarray:
        touch = {key: observation[key] for key in ft.TACTILE}
        self.seen.append(touch)
        changed = self.change(touch, len(self.seen) - 1)
        action = self.policy.act({**observation, **changed})
        self.done, self.given_up = self.policy.done, self.policy.given_up
        return action


def run(config: Config) -> dict[str, Any]:
    """Return success and force by task and change of touch, with the trials."""
    lines, rows = [TABLE_HEAD], []
    for task in config.tasks:
        make, env = prepare_policy(config.policy, deployed(task))
        pairs = list(pairwise(trial_specs(env, config.episodes + 1, config.seed)))
        with parallel_map(partial(_audit, env, make), pairs, config.workers) as found:
            trials = list(track(found, f"{task}: audit", "episode", total=len(pairs)))
        for name in trials[0]:
            of_name = tuple(trial[name] for trial in trials)
            lines.append(table_row(f"{task}, touch {name}", Evaluation(of_name)))
            rows.append({"what": f"{task}, touch {name}", "trials": [asdict(t) for t in of_name]})
    return {"table": "\n".join(lines), "rows": rows}


def _audit(
    env: TaskConfig, make: Callable[[Any], Actor], pair: tuple[EpisodeSpec, EpisodeSpec]
) -> dict[str, Trial]:
    spec, next_spec = pair

    def watch(spec: EpisodeSpec, change: Change) -> tuple[Trial, list[Observation]]:
        seen: list[Observation] = []
        return run_trial(env, lambda made: _Watched(make(made), change, seen), spec), seen

    unchanged, own = watch(spec, lambda touch, _: touch)
    _, others = watch(next_spec, lambda touch, _: touch)
    order = np.random.default_rng(spec.seed).permutation(len(own))
    changes: dict[str, Change] = {
        "removed": lambda _, tick: own[0],
        "shuffled": lambda _, tick: own[order[tick % len(order)]],
        "of another episode": partial(_at, others),
        "of the other fingertip": lambda touch, _: dict(
            zip(ft.TACTILE, _swapped(touch), strict=True)
        ),
    }
    return {UNCHANGED: unchanged} | {name: watch(spec, c)[0] for name, c in changes.items()}


def _at(run: Sequence[Observation], _: Observation, tick: int) -> Observation:
    return run[min(tick, len(run) - 1)]


def _swapped(touch: Observation) -> list[np.ndarray]:
    return [touch[key] for key in reversed(ft.TACTILE)]

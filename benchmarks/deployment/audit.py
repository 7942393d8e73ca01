"""Inputs that a policy's success depends on: each one replaced by another episode's, tick by tick.

A policy that does as well with another episode's touch does not use touch. The other episode is a run
of the same policy on the next wire or in the next scene; if it is shorter, its last tick is repeated.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.deployment.trials import TABLE_HEAD, UNCHANGED, DeployedOptions, table_row
from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.policies.by_name import prepare_policy
from touchgoal.policies.evaluation.evaluate import Evaluation, Trial, run_trial, trial_specs
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import TaskConfig


@checked_dataclass
class Config(DeployedOptions):
    """Options of benchmark audit."""


@dataclass
class _Watched(Actor):
    """A policy that keeps what it observed."""

    policy: Actor
    seen: list[Observation] = field(default_factory=list)

    def act(self, observation: Observation) -> np.ndarray:
        self.seen.append(observation)
        return self.policy.act(observation)


@dataclass
class _Replaced(Actor):
    """A policy that observes some columns of another episode."""

    policy: Actor
    keys: tuple[str, ...]
    other: list[Observation]
    tick: int = -1

    def act(self, observation: Observation) -> np.ndarray:
        self.tick = min(self.tick + 1, len(self.other) - 1)
        return self.policy.act(observation | {k: self.other[self.tick][k] for k in self.keys})


def run(config: Config) -> dict[str, Any]:
    """Return success by task and replaced input, with the trials."""
    lines, rows = [TABLE_HEAD], []
    for task in config.tasks:
        maker, env = prepare_policy(config.policy, config.environment(task))
        specs = trial_specs(env, config.episodes + 1, config.seed)
        audit = partial(_audit, env, maker)
        with parallel_map(audit, list(pairwise(specs)), config.workers) as found:
            trials = list(track(found, f"{task}: audit", "episode", total=config.episodes))
        for name in trials[0]:
            of_name = tuple(trial[name] for trial in trials)
            lines.append(table_row(f"{task}, {name}", Evaluation(of_name)))
            rows.append({"what": f"{task}, {name}", "trials": [asdict(t) for t in of_name]})
    return {"table": "\n".join(lines), "rows": rows}


def _inputs(env: TaskConfig) -> dict[str, tuple[str, ...]]:
    """Return the inputs that a policy may read in an environment: name -> columns."""
    inputs: dict[str, tuple[str, ...]] = {"touch": ft.TACTILE} if env.tactile else {}
    inputs |= {name: (ft.IMAGE_PREFIX + name,) for name in env.cameras}
    return inputs | {"arm's state": (ft.STATE, ft.TCP_POSE, ft.COMMAND), "wrench": (ft.WRENCH,)}


def _audit(
    env: TaskConfig, maker: Callable[[Any], Actor], pair: tuple[EpisodeSpec, EpisodeSpec]
) -> dict[str, Trial]:
    """Run the second episode unchanged, then the first with each of its inputs taken from the second."""
    spec, other = pair
    watched: list[_Watched] = []

    def watch(made_for: Any) -> Actor:
        watched.append(_Watched(maker(made_for)))
        return watched[-1]

    trials = {UNCHANGED: run_trial(env, watch, other)}
    for name, keys in _inputs(env).items():
        trials[f"{name} of another episode"] = run_trial(
            env, lambda made_for, k=keys: _Replaced(maker(made_for), k, watched[0].seen), spec
        )
    return trials

"""Fragile carry: success by what a policy reads, beside the expert and one force for every rod.

Every row gets the same rods, starts and tugs.
"""

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.options import CORES, BenchmarkOptions
from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.policies.by_name import prepare_policy
from touchgoal.policies.checkpoint import load
from touchgoal.policies.evaluation.evaluate import Trial, run_trials, trial_specs
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.network import PolicyConfig
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import FragileCarryConfig, TaskConfig
from touchgoal.sim_envs.experts.fragile_carry import FragileCarryExpert
from touchgoal.sim_envs.fragile_carry import FragileCarry, width_for

_FAILURES = ("crushed", "dropped", "tilted", "time")
_ONE_FORCE = 4.5  # N: 1.6 times the middle, on a log scale, of the forces that hold


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark fragile-carry."""

    policies: tuple[Path, ...] = ()
    """Folders of policies from train-policy; default: none, the baselines alone."""
    episodes: Count = 100
    """Episodes of each row."""
    seed: Seed = seeds.POLICY_TEST.start
    """Random seed of the first episode; each further one adds one."""
    env: FragileCarryConfig = FragileCarryConfig()
    """Options of the task."""
    workers: Count = CORES
    """Processes that simulate."""


@dataclass(frozen=True)
class OneForce(Actor):
    """Moves as the expert does, and squeezes every rod with one force (N)."""

    expert: FragileCarryExpert
    force: float

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next action."""
        return np.append(self.expert.act(observation)[:-1], width_for(self.force))


def _one_force(env: FragileCarry) -> OneForce:
    return OneForce(FragileCarryExpert(env), _ONE_FORCE)


def run(config: Config) -> dict[str, Any]:
    """Return success by row, with the trials."""
    blind = prepare_policy("expert", config.env)[1]
    rows: dict[str, tuple[Callable[[Any], Actor], TaskConfig]] = {
        "expert, which knows the slip": (FragileCarryExpert, blind),
        f"{_ONE_FORCE:g} N on every rod": (_one_force, blind),
    }
    for folder in config.policies:
        maker, env = prepare_policy(folder, config.env)
        name = read_inputs(load(folder).config)
        if name in rows:
            raise UserError(f"two policies read {name}: name one of them")
        rows[name] = maker, env
    specs = trial_specs(config.env, config.episodes, config.seed)
    width = max(map(len, rows)) + 2
    lines = [f"{'':<{width}}{'success [95 % Wilson]':<24}" + "".join(f"{f:>9}" for f in _FAILURES)]
    results = {}
    for name, (maker, env) in rows.items():
        trials = list(run_trials(env, maker, specs, config.workers))
        lines.append(f"{name:<{width}}{_line(trials)}")
        print(lines[-1], file=sys.stderr, flush=True)
        results[name] = [asdict(trial) for trial in trials]
    return {"table": "\n".join(lines), "closed_loop": results}


def read_inputs(config: PolicyConfig) -> str:
    """Return what a policy reads, in words."""
    parts = ["touch"] * (config.touch_dim > 0 or config.end_to_end is not None)
    parts += ["sight"] * (config.images is not None)
    parts += ["state"] + ["force on the hand"] * (ft.WRENCH in config.proprioception)
    return ", ".join(parts)


def _line(trials: list[Trial]) -> str:
    failures = Counter(trial.failure for trial in trials)
    rate = SuccessRate(sum(trial.success for trial in trials), len(trials))
    return f"{rate!s:<24}" + "".join(f"{failures[name]:>9}" for name in _FAILURES)

"""Success in the environment under late observations, plans and commands, otherwise as deployed."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from benchmarks.deployment.trials import TrialOptions, try_cases
from touchgoal.runtime.option_types import NotNegative, Positive, checked_dataclass
from touchgoal.sim_envs.cell.deployment import DeploymentConfig
from touchgoal.sim_envs.config import ENVS, TaskName


@checked_dataclass
class Config(TrialOptions):
    """Options of benchmark policy-delay."""

    task: TaskName = "pick-place"
    """Task; for the maze, on validation wires."""
    delay: tuple[NotNegative, ...] = (0.0, 50.0, 100.0, 150.0)
    """Delay from sensing to command, ms, half before the policy, half after; planning adds a tick."""
    jitter: tuple[NotNegative, ...] = (0.0, 50.0)
    """Largest extra delay of each half, drawn each tick, ms."""
    rates: tuple[Positive, ...] = (30.0, 15.0)
    """Image rates, Hz."""


def run(config: Config) -> dict[str, Any]:
    """Return success by delay, jitter and image rate, with the trials."""
    env = replace(ENVS[config.task], as_deployed=True)
    return try_cases(
        config, ((what, replace(env, deployment=own)) for what, own in _delays(config))
    )


def _delays(config: Config) -> Iterator[tuple[str, DeploymentConfig]]:
    for rate in config.rates:
        for jitter in config.jitter:
            for delay in config.delay:
                half = (delay / 2000, delay / 2000)  # s: before the policy, and after it
                more = (jitter / 1000, jitter / 1000)
                late = DeploymentConfig(state_delay=half, image_delay=half, command_delay=half)
                what = f"{delay:.0f} ms, jitter {jitter:.0f} ms, pictures {rate:.0f} Hz"
                yield what, replace(late, jitter=more, image_rate=rate)

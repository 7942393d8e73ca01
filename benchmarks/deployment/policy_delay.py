"""Success in the environment under late observations, plans and commands, or by cause of failure.

With delays the arm is otherwise as deployed. By cause, each part of `--env.as-deployed` acts alone,
and then all parts but this one.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from benchmarks.deployment.trials import TrialOptions, try_cases
from touchgoal.runtime.option_types import NotNegative, Positive, checked_dataclass
from touchgoal.sim_envs.cell.deployment import AS_DEPLOYED, IDEAL_DEPLOYMENT, DeploymentConfig
from touchgoal.sim_envs.config import ENVS, TaskName


@checked_dataclass
class Config(TrialOptions):
    """Options of benchmark policy-delay."""

    task: TaskName = "pick-place"
    """Task; for the maze, on validation wires."""
    causes: bool = False
    """Run an ablation instead of delays: each effect of a deployment alone, then all the others."""
    delay: tuple[NotNegative, ...] = (0.0, 50.0, 100.0, 150.0)
    """Delay from sensing to command, ms, half before the policy, half after; planning adds a tick."""
    jitter: tuple[NotNegative, ...] = (0.0, 50.0)
    """Largest extra delay of each half, drawn each tick, ms."""
    rates: tuple[Positive, ...] = (30.0, 15.0)
    """Image rates, Hz."""


_PARTS = {  # parts of `--env.as-deployed`
    "lag, limits and tracker": ("tracker",),
    "a Franka Hand": ("franka_hand",),
    "an estimated wrench": ("estimated_wrench",),
    "late states and pictures": ("state_delay", "image_delay", "image_rate", "jitter"),
    "late commands": ("command_delay",),
    "late plans": ("plan_ticks",),
}


def run(config: Config) -> dict[str, Any]:
    """Return success by delay, jitter and image rate, or by cause, with the trials."""
    env = ENVS[config.task]
    cases = _causes() if config.causes else _delays(config)
    envs = ((what, replace(env, as_deployed=whole, deployment=own)) for what, whole, own in cases)
    return try_cases(config, envs)


def _delays(config: Config) -> Iterator[tuple[str, bool, DeploymentConfig]]:
    for rate in config.rates:
        for jitter in config.jitter:
            for delay in config.delay:
                half = (delay / 2000, delay / 2000)  # s: before the policy, and after it
                more = (jitter / 1000, jitter / 1000)
                late = DeploymentConfig(state_delay=half, image_delay=half, command_delay=half)
                what = f"{delay:.0f} ms, jitter {jitter:.0f} ms, pictures {rate:.0f} Hz"
                yield what, True, replace(late, jitter=more, image_rate=rate)


def _causes() -> Iterator[tuple[str, bool, DeploymentConfig]]:
    yield "the plain environment", False, DeploymentConfig()
    for what, fields in _PARTS.items():
        own = {field: getattr(AS_DEPLOYED, field) for field in fields}
        yield f"only {what}", False, DeploymentConfig(**own)
    yield "as deployed", True, DeploymentConfig()
    for what, fields in _PARTS.items():
        own = {field: getattr(IDEAL_DEPLOYMENT, field) for field in fields}
        yield f"as deployed, but for {what}", True, DeploymentConfig(**own)

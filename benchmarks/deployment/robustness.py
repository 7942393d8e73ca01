"""Success of the shipped policies under changes that training has not shown."""

from dataclasses import replace
from typing import Any

from touchgoal.benchmarks.deployment.trials import TrialOptions, try_cases
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.sim_envs.config import ENVS, BrightnessChange, TaskName


@checked_dataclass
class Config(TrialOptions):
    """Options of benchmark robustness."""

    tasks: tuple[TaskName, ...] = tuple(ENVS)
    """Tasks; the maze is on validation wires."""
    light: tuple[BrightnessChange, ...] = (-0.15, -0.05, 0.0, 0.1, -0.8)
    """Changes of the fingertips' light after the first picture, as shares; a row each."""
    as_deployed: bool = False
    """Let the arm behave as deployed."""


def run(config: Config) -> dict[str, Any]:
    """Return success by task and change, with the trials."""
    cases = (
        (
            f"{task}, light {100 * change:+.0f} %" if change else f"{task}, unchanged",
            replace(ENVS[task], light_change=(change,), as_deployed=config.as_deployed),
        )
        for task in config.tasks
        for change in config.light
    )
    return try_cases(config, cases)

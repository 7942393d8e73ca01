"""The tasks: environments by name or config, and their experts."""

from typing import Any, Literal, overload

from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import BeadMazeConfig, EnvConfig, Outcome, TaskConfig, TaskName
from touchgoal.sim_envs.experts.bead_maze import BeadMazeExpert
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.pick_place import PickPlace

_ENVIRONMENTS = {env.task: env for env in (PickPlace, BeadMaze)}


@overload
def make(
    task: Literal["pick-place"], *, render_mode: str | None = None, **options: Any
) -> PickPlace: ...
@overload
def make(
    task: Literal["bead-maze"], *, render_mode: str | None = None, **options: Any
) -> BeadMaze: ...
def make(task: str, *, render_mode: str | None = None, **options: Any) -> FrankaTactileEnv:
    """Make the Gymnasium environment of a task; see `rewards.environments.make`, which users call.

    UserError: there is no such task or option, or a value is out of its range.
    """
    if task not in _ENVIRONMENTS:
        raise UserError(f"unknown task {task!r}; choose from: {', '.join(_ENVIRONMENTS)}")
    return _ENVIRONMENTS[task](render_mode=render_mode, **options)


def make_env(config: TaskConfig) -> FrankaTactileEnv:
    """Make the environment of a task's config."""
    return BeadMaze(config) if isinstance(config, BeadMazeConfig) else PickPlace(config)


def task_name(config: EnvConfig) -> TaskName:
    """Return the commands' name of a config's task."""
    return "bead-maze" if isinstance(config, BeadMazeConfig) else "pick-place"


def make_expert(
    env: FrankaTactileEnv, outcome: Outcome = "success"
) -> PickPlaceExpert | BeadMazeExpert:
    """Make the expert for an environment after its reset."""
    if isinstance(env, PickPlace):
        return PickPlaceExpert(env, outcome)
    assert isinstance(env, BeadMaze)
    if outcome != "success":
        raise UserError(f"the bead maze's expert cannot {outcome!r}; ask for outcome success")
    return BeadMazeExpert(env)

"""The tasks: environments by config, and their experts."""

from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import BeadMazeConfig, EnvConfig, Outcome, TaskConfig, TaskName
from touchgoal.sim_envs.experts.bead_maze import BeadMazeExpert
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.pick_place import PickPlace


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

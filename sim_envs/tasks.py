"""The tasks: which environment a config stands for, and who demonstrates it."""

from touchgoal.control.errors import UserError
from touchgoal.sim_envs.base import FrankaTactileEnv
from touchgoal.sim_envs.bead_maze import BeadMaze, BeadMazeConfig
from touchgoal.sim_envs.experts.bead_maze import BeadMazeExpert
from touchgoal.sim_envs.experts.pick_place import Outcome, PickPlaceExpert
from touchgoal.sim_envs.pick_place import PickPlace, PickPlaceConfig

TaskConfig = PickPlaceConfig | BeadMazeConfig


def make_env(config: TaskConfig) -> FrankaTactileEnv:
    """The environment of a task's config."""
    return BeadMaze(config) if isinstance(config, BeadMazeConfig) else PickPlace(config)


def make_expert(
    env: FrankaTactileEnv, outcome: Outcome = "success"
) -> PickPlaceExpert | BeadMazeExpert:
    """The expert for an environment after its reset."""
    if isinstance(env, PickPlace):
        return PickPlaceExpert(env, outcome)
    assert isinstance(env, BeadMaze)
    if outcome != "success":
        raise UserError(f"the bead maze's expert cannot {outcome!r}; ask for outcome success")
    return BeadMazeExpert(env)

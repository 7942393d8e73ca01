"""The tasks: environments by config, and their experts."""

from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import EnvConfig, Outcome, TaskConfig
from touchgoal.sim_envs.experts.bead_maze import BeadMazeExpert
from touchgoal.sim_envs.experts.fragile_carry import FragileCarryExpert
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.fragile_carry import FragileCarry
from touchgoal.sim_envs.pick_place import PickPlace

ENVIRONMENTS: dict[type[EnvConfig], type[PickPlace | BeadMaze | FragileCarry]] = {
    type(task.default_config): task for task in (PickPlace, BeadMaze, FragileCarry)
}


def make_env(config: TaskConfig) -> FrankaTactileEnv:
    """Make the environment of a task's config."""
    return ENVIRONMENTS[type(config)](config)


def make_expert(
    env: FrankaTactileEnv, outcome: Outcome = "success"
) -> PickPlaceExpert | BeadMazeExpert | FragileCarryExpert:
    """Make the expert for an environment after its reset."""
    if isinstance(env, PickPlace):
        return PickPlaceExpert(env, outcome)
    if outcome != "success":
        raise UserError(f"the expert of {env.task} cannot {outcome!r}; ask for outcome success")
    if isinstance(env, BeadMaze):
        return BeadMazeExpert(env)
    assert isinstance(env, FragileCarry)
    return FragileCarryExpert(env)

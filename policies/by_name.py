"""Which policy is meant: `--policy expert`, `shipped`, a folder, or a class of one's own.

A user's own class: see `control/deployment/user_policy.py`.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.deployment.user_policy import find_user_policy, preferred_env_config
from touchgoal.episodes.recording import Actor
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, SavedPolicy, find_policy, suggestion
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import TaskConfig, TaskName
from touchgoal.sim_envs.tasks import make_expert, task_name

BUILT_IN = {
    "expert": "the task's expert, which sees the simulator's state",
    "follower": "bead-maze: the classical one, which feels the force on the hand",
    "shipped": "the policy that ships for the task",
    **{name: f"the policy that ships for {name}" for name in SHIPPED_POLICIES},
}
"""Names of policies, and what they are."""

PolicyMaker = Callable[[Any], Actor]
"""Makes an actor for one episode of an environment, after its reset; it must pickle."""


def scripted(task: TaskName) -> str:
    """The task's own policy without learning that an arm can do: it does not see the simulator's state
    but for where things are at the start."""
    return "follower" if task == "bead-maze" else "expert"


def choose_policy(name: str | Path, task: TaskConfig) -> PolicyMaker:
    """What makes the policy that a command or a script names.

    Args:
        name: one of `BUILT_IN`, a folder that train-policy made, `module:Class` or `file.py:Class`.
        task: options of the task it is to act in.

    Raises:
        UserError: no such policy, or it cannot act in the task. Nothing was simulated yet.
    """
    chosen, where = str(name), task_name(task)
    if chosen == "expert":
        return make_expert
    if chosen == "follower":
        if where != "bead-maze":
            raise UserError("the follower is for the bead maze; add: --task bead-maze")
        return follower
    if (found := find_user_policy(chosen)) is not None:
        return found
    if chosen == "shipped":
        return _fitting(SavedPolicy(SHIPPED_POLICIES[where]), task)
    try:
        folder = find_policy(chosen)
    except UserError as error:
        if Path(chosen).is_dir():
            raise UserError(
                f"no policy in {chosen}: train one with touchgoal train-policy"
            ) from error
        raise UserError(
            f"there is no policy {chosen!r}: {suggestion(chosen, tuple(BUILT_IN))}, or a class of your "
            "own as module:Class or file.py:Class"
        ) from error
    return _fitting(SavedPolicy(folder), task)


def _fitting(policy: SavedPolicy, task: TaskConfig) -> SavedPolicy:
    """Return the policy; UserError if it cannot act in the task."""
    policy.env_config(task)
    return policy


def env_config_for(policy: PolicyMaker, config: TaskConfig) -> TaskConfig:
    """The task's options with the pictures that the policy looks at: no others are rendered."""
    if policy in (make_expert, follower):
        return replace(config, tactile=False, cameras=())
    return preferred_env_config(policy, config)


def follower(env: FrankaTactileEnv) -> WireFollower:
    """The bead maze's classical policy."""
    return WireFollower(env.config.control_hz)

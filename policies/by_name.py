"""Policies by name: `expert`, `follower`, `shipped`, a folder, a user's class or a server.

For the last two see `control/deployment/user_policy.py`.
"""

import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from touchgoal.control.cell.config import CellConfig, SimulatedTask
from touchgoal.control.deployment.actors import DeployedPolicy
from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.deployment.user_policy import Policy, UserPolicy, find_user_policy
from touchgoal.control.policy_server.policy import PolicyServer
from touchgoal.episodes.recording import Actor
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.checkpoint import (
    EPISODE_OBJECT,
    SHIPPED_POLICIES,
    SavedPolicy,
    find_policy,
    suggestion,
    with_target,
)
from touchgoal.policies.config import POLICIES
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import PickPlaceConfig, TaskConfig
from touchgoal.sim_envs.tasks import make_expert, task_name

PolicyMaker = Callable[[Any], Actor]
"""Makes the policy for one episode of an environment, after its reset; it must pickle."""
AnyPolicy = str | Path | LearnedPolicy | Policy | type
"""A name or folder as for `--policy`, a loaded policy, or a user's class or an object of it."""


def scripted(task: SimulatedTask) -> str:
    """Return the task's scripted policy that an arm can run."""
    return "follower" if task == "bead-maze" else "expert"


def prepare_policy(
    policy: AnyPolicy, task: TaskConfig, target: str | None = None
) -> tuple[PolicyMaker, TaskConfig]:
    """Return the maker of a policy, and the task's options with the images that it reads.

    `target` is the object in words, see `SavedPolicy`.

    UserError: no such policy, it cannot act in the task, an option of the task is set to
    something else than the policy needs, or it takes no target.
    """
    maker = choose_policy(policy, task)
    if isinstance(maker, SavedPolicy):
        maker = with_target(maker, target)
        _warn_without_target(maker, task)
    elif target is not None:
        raise UserError(f"the policy {policy} takes no target: leave it out")
    needed = env_config_for(maker, task)
    default = type(task)()
    for name in (field.name for field in fields(task)):
        given, runs = getattr(task, name), getattr(needed, name)
        unread = name == "camera_size" and not needed.cameras
        if given != getattr(default, name) and (given != runs or unread):
            instead = "reads no camera" if unread else f"runs with {_option(name, runs)}"
            raise UserError(
                f"{_option(name, given)}: the policy {policy} {instead}; leave the option out"
            )
    return maker, needed


def _warn_without_target(policy: SavedPolicy, task: TaskConfig) -> None:
    if isinstance(task, PickPlaceConfig) and task.distractors and not policy.target:
        print(
            f"warning: nothing says which of {1 + task.distractors} objects is meant: add --target "
            f'"the red block", or "the {EPISODE_OBJECT}" for the name of each episode\'s object',
            file=sys.stderr,
        )


def _option(name: str, value: object) -> str:
    """Return an option of the environment as it is typed."""
    name = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--env.{name}" if value else f"--env.no-{name}"
    words = map(str, value) if isinstance(value, tuple) else [str(value)]
    return " ".join([f"--env.{name}", *words])


def choose_policy(policy: AnyPolicy, task: TaskConfig) -> PolicyMaker:
    """Return the maker of a policy that is named, loaded, or a user's own.

    UserError: no such policy.
    """
    if isinstance(policy, LearnedPolicy) and policy.directory is not None:
        return SavedPolicy(policy.directory, policy.plan_ticks, policy.target)
    if not isinstance(policy, str | Path):
        kind = policy if isinstance(policy, type) else type(policy)
        return UserPolicy(kind.__name__, policy)
    name, where = str(policy), task_name(task)
    if name == "expert":
        return make_expert
    if name == "follower":
        if where != "bead-maze":
            raise UserError("the follower is for the bead maze; add: --task bead-maze")
        return follower
    if (found := find_user_policy(name)) is not None:
        return found
    if name == "shipped" and where not in SHIPPED_POLICIES:
        raise UserError(f"no policy ships for {where}: train one, or take the expert")
    if name == "shipped":
        return SavedPolicy(SHIPPED_POLICIES[where])
    try:
        return SavedPolicy(find_policy(name))
    except UserError as error:
        if Path(name).is_dir():
            raise UserError(
                f"no policy in {name}: train one with touchgoal train-policy"
            ) from error
        raise UserError(
            f"there is no policy {name!r}: {suggestion(name, tuple(POLICIES))}, or a class of your "
            "own as module:Class or file.py:Class, or a server as ws://host:port"
        ) from error


def env_config_for(maker: PolicyMaker, task: TaskConfig) -> TaskConfig:
    """Return the task's options with the images that the policy reads: no others are rendered.

    UserError: the policy cannot act in the task.
    """
    if isinstance(maker, SavedPolicy | UserPolicy | PolicyServer):
        return maker.env_config(task)
    return replace(task, tactile=False, cameras=())


def follower(env: FrankaTactileEnv) -> WireFollower:
    """Return the bead maze's classical policy."""
    return WireFollower(env.config.control_hz)


def load_saved_policy(cell: CellConfig, task: TaskConfig) -> DeployedPolicy:
    """Return the policy on disk that the cell names; UserError if it does not fit."""
    shipped = cell.task.policy == "shipped"
    directory = SHIPPED_POLICIES[cell.task.simulated] if shipped else find_policy(cell.task.policy)
    target = cell.task.target
    if target is not None and EPISODE_OBJECT in target:
        raise UserError(f"{EPISODE_OBJECT} is known in run-policy alone: name the object itself")
    policy = with_target(SavedPolicy(directory), target)()
    return DeployedPolicy.for_cell(cell, policy, policy.env_config(task, cell.task.name))

"""The policy that a command names: `expert`, `follower`, `shipped`, a folder, a user's class or a server."""

import shlex
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.deployment.user_policy import UserPolicy, find_user_policy
from touchgoal.control.interfaces import Actor, Planner, Policy
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.checkpoint import EPISODE_OBJECT, SavedPolicy, find_policy
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig, task_name
from touchgoal.sim_envs.tasks import make_expert


def prepare_policy(
    policy: str | Path | Policy | type, task: TaskConfig, target: str | None = None
) -> tuple[Callable[[Any], Actor], TaskConfig]:
    """Return what makes a policy for an episode, and the task's options with the images it reads.

    The first takes an environment after its reset, and pickles. Cameras that `task` asks for are observed
    beside those that the policy reads.

    UserError: no such policy, it cannot act in the task, an option of the task is set to
    something else than the policy needs, or it takes no target.

    Args:
        policy: a name or folder as for `--policy`, a loaded policy, or a user's class or an object of it.
        target: the object in words, see `SavedPolicy`.
    """
    make, needed = choose_policy(policy, task, target)
    if isinstance(make, SavedPolicy):
        _warn_without_target(make, task)
    default = type(task)()
    if task.cameras != default.cameras and {*needed.cameras} <= {*task.cameras}:
        needed = replace(needed, cameras=task.cameras)  # such as those that a judge looks through
    for name in (field.name for field in fields(task)):
        given, runs = getattr(task, name), getattr(needed, name)
        unread = name == "camera_size" and not needed.cameras
        if given != getattr(default, name) and (given != runs or unread):
            instead = "reads no camera" if unread else f"runs with {typed_option(name, runs)}"
            raise UserError(
                f"{typed_option(name, given)}: the policy {policy} {instead}; leave the option out"
            )
    return make, needed


def choose_policy(
    policy: str | Path | Policy | type, task: TaskConfig, target: str | None = None
) -> tuple[Callable[[Any], Actor], TaskConfig]:
    """Return what `prepare_policy` does, without a check of the task's options."""
    if policy in ("expert", "follower"):
        make = make_expert if policy == "expert" else follower
        if make is follower and not isinstance(task, BeadMazeConfig):
            raise UserError("the follower is for the bead maze; add: --task bead-maze")
        needed = replace(task, tactile=False, cameras=())
    else:
        make = _maker(policy, task_name(task))
        if isinstance(make, SavedPolicy):
            make, target = make.with_target(target), None
        needed = make().env_config(task)
    if target is not None:
        raise UserError(f"the policy {policy} takes no target: leave it out")
    return make, needed


def _maker(policy: str | Path | Policy | type, task: str) -> Callable[..., Planner]:
    if isinstance(policy, LearnedPolicy) and policy.directory is not None:
        return SavedPolicy(policy.directory, policy.plan_ticks, policy.target)
    if not isinstance(policy, str | Path):
        kind = policy if isinstance(policy, type) else type(policy)
        return partial(UserPolicy, kind.__name__, policy)
    return find_user_policy(str(policy)) or SavedPolicy(find_policy(policy, task))


def follower(env: Any) -> WireFollower:
    """Return the bead maze's classical policy."""
    return WireFollower(env.config.control_hz)


def _warn_without_target(policy: SavedPolicy, task: TaskConfig) -> None:
    if isinstance(task, PickPlaceConfig) and task.distractors and not policy.target:
        print(
            f"warning: nothing says which of {1 + task.distractors} objects is meant: add --target "
            f'"the red block", or "the {EPISODE_OBJECT}" for the name of each episode\'s object',
            file=sys.stderr,
        )


def typed_option(name: str, value: object) -> str:
    """Return an option of the environment as it is typed."""
    name = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--env.{name}" if value else f"--env.no-{name}"
    words = map(str, value) if isinstance(value, tuple) else [str(value)]
    return shlex.join([f"--env.{name}", *words])

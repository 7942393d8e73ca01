"""Which policy is meant: `--policy expert`, `shipped`, a folder, or a class of one's own.

A policy of one's own is a class with two methods; nothing needs to be inherited::

    class MyPolicy:
        def reset(self) -> None: ...  # an episode begins
        def act(self, observation: dict[str, np.ndarray]) -> np.ndarray: ...

`act` gets the observation of a tick (keys and units: `control/features.py`) and returns the action
for the next one: the joint change of this tick (rad, one number a joint), then the gripper's width
target (m). The class is named `module:Class` or `path/to/file.py:Class`, and is made without
arguments, once an episode, in the process that simulates it. If it has a method
`env_config(config)`, that returns the options of the environment it needs, such as its cameras.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from touchgoal.episodes.recording import Actor
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, SavedPolicy, find_policy, suggestion
from touchgoal.policies.follower import WireFollower
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.base import FrankaTactileEnv
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


@runtime_checkable
class UserPolicy(Protocol):
    """What a user's own policy is to the rest: two methods."""

    def reset(self) -> None:
        """An episode begins."""
        ...

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The action for the next tick."""
        ...


@dataclass(frozen=True)
class ImportedPolicy:
    """Makes a policy of one's own in any process.

    Attributes:
        module: importable name, or path of a Python file.
        attribute: name of the class.
    """

    module: str
    attribute: str

    def __call__(self, env: object = None) -> UserPolicy:
        """One for an episode."""
        policy = self.load()()
        policy.reset()
        return policy

    def env_config(self, config: TaskConfig) -> TaskConfig:
        """Options of the environment that the policy asks for, if it does."""
        return preferred_env_config(self.load()(), config)

    def load(self) -> Callable[[], UserPolicy]:
        """The class; UserError if there is none, or it lacks a method."""
        module = _import_file(Path(self.module)) if self._is_file else _import(self.module)
        found = getattr(module, self.attribute, None)
        if found is None:
            close = get_close_matches(self.attribute, vars(module), 1)
            guess = f": did you mean {close[0]}?" if close else ""
            raise UserError(f"{self.module} has no {self.attribute}{guess}")
        for method in ("reset", "act"):
            if not callable(getattr(found, method, None)):
                raise UserError(
                    f"{self.module}:{self.attribute} has no method {method}: a policy has "
                    "reset() and act(observation)"
                )
        return found

    @property
    def _is_file(self) -> bool:
        return self.module.endswith(".py")


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
        return SavedPolicy(SHIPPED_POLICIES[where]).check_task(task)
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
    return SavedPolicy(folder).check_task(task)


def find_user_policy(name: str) -> ImportedPolicy | None:
    """A policy of one's own, named `module:Class` or `file.py:Class`; None of any other name.

    UserError if the class is not there, or lacks a method.
    """
    module, colon, attribute = name.rpartition(":")
    if not colon or not attribute.isidentifier():
        return None
    policy = ImportedPolicy(module, attribute)
    policy.load()
    return policy


def env_config_for(policy: PolicyMaker, config: TaskConfig) -> TaskConfig:
    """The task's options with the pictures that the policy looks at: no others are rendered."""
    if policy in (make_expert, follower):
        return replace(config, tactile=False, cameras=())
    return preferred_env_config(policy, config)


def preferred_env_config(policy: object, config: TaskConfig) -> TaskConfig:
    """The options that a policy prefers: what its `env_config` makes of them; without one they stay."""
    make = getattr(policy, "env_config", None)
    return config if make is None else make(config)


def follower(env: FrankaTactileEnv) -> WireFollower:
    """The bead maze's classical policy."""
    return WireFollower(env.config.control_hz)


def _import(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(f"cannot import {name} for the policy: {error}") from error


def _import_file(path: Path) -> Any:
    path = path.resolve()
    if not path.is_file():
        raise UserError(f"there is no file {path} to take the policy from")
    name = f"touchgoal_user_{path.stem}"
    known = sys.modules.get(name)
    if known is not None and known.__file__ == str(path):
        return known
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module

"""A user's own policy: a class with two methods, named `module:Class` or `path/to/file.py:Class`.

Nothing needs to be inherited::

    class MyPolicy:
        def reset(self) -> None: ...  # an episode begins
        def act(self, observation: dict[str, np.ndarray]) -> np.ndarray: ...

`act` gets the observation of a tick (keys and units: `control/features.py`) and returns the action for
the next one: the joint change of this tick (rad, one number a joint), then the gripper's target width
(m). The class is made without arguments, once an episode, in the process that simulates it. An optional
method `env_config(config)` returns the options of the environment that it needs, such as its cameras.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.runtime.errors import UserError

Config = TypeVar("Config")


@runtime_checkable
class UserPolicy(Protocol):
    """A policy: two methods."""

    def reset(self) -> None:
        """Begin an episode."""
        ...

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action for the next tick."""
        ...


@dataclass(frozen=True)
class ImportedPolicy:
    """Maker of a user's policy, in any process.

    Attributes:
        module: importable name, or path of a Python file.
        attribute: name of the class.
    """

    module: str
    attribute: str

    def __call__(self, env: object = None) -> UserPolicy:
        """Make one for an episode."""
        policy = self.load()()
        policy.reset()
        return policy

    def env_config(self, config: Config) -> Config:
        """Return the options of the environment with what the policy asks for, if it does."""
        return preferred_env_config(self.load()(), config)

    def load(self) -> Callable[[], UserPolicy]:
        """Return the class; UserError if there is none, or it lacks a method."""
        is_file = self.module.endswith(".py")
        module = _import_file(Path(self.module)) if is_file else _import(self.module)
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


def find_user_policy(name: str) -> ImportedPolicy | None:
    """Return the user's policy `module:Class` or `file.py:Class`; None for any other name.

    UserError if the class is not there, or lacks a method.
    """
    module, colon, attribute = name.rpartition(":")
    if not colon or not attribute.isidentifier():
        return None
    policy = ImportedPolicy(module, attribute)
    policy.load()
    return policy


def preferred_env_config(policy: object, config: Config) -> Config:
    """Return what the policy's `env_config` makes of these options; without one they stay."""
    make = getattr(policy, "env_config", None)
    return config if make is None else make(config)


@dataclass(frozen=True)
class _EveryTick:
    """Horizons of a policy that answers every tick."""

    observation_horizon: int = 1
    execution_horizon: int = 1
    control_hz: int = ft.CONTROL_HZ


class UserPolicyPlanner:
    """A user's policy as plans of one tick, so that the control loop never waits for a slow one."""

    config = _EveryTick()
    ticks_seen = 1

    def __init__(self, policy: UserPolicy) -> None:
        self._policy = policy

    def embed(self, seen: Sequence[Observation]) -> None:
        """Do nothing: no work is done ahead."""

    def plan(self, seen: Sequence[Observation]) -> Float32[np.ndarray, "1 8"]:
        """Return the action for the next tick; UserError if it has another shape."""
        action = np.asarray(self._policy.act(dict(seen[-1])), np.float32)
        if action.shape != (ft.N_JOINTS + 1,):
            raise UserError(
                f"the policy's action has the shape {action.shape}: give {ft.N_JOINTS} joint changes "
                "(rad) and the gripper's width (m)"
            )
        return action[None]


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

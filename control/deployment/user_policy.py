"""A user's own policy: a class with two methods, `module:Class` or `file.py:Class`
(docs/own_policy.md), or a server (`policy_server/`).

The class is made without arguments, once per episode, in the process that simulates it. An optional
method `env_config(config)` returns the options of the environment that it needs, such as its
cameras.
"""

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.policy_server.policy import PolicyServer
from touchgoal.runtime.errors import UserError

Config = TypeVar("Config")


@runtime_checkable
class Policy(Protocol):
    """A policy: two methods."""

    def reset(self) -> None:
        """Begin an episode."""

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action of the next tick: joint change (rad, one a joint), gripper's width (m).

        Keys and units of the observation: `control/features.py`.
        """
        ...


@dataclass(frozen=True)
class _EveryTick:
    """Horizons of a policy that answers every tick."""

    observation_horizon: int = 1
    execution_horizon: int = 1
    control_hz: int = ft.CONTROL_HZ


class CheckedPolicy:
    """A user's policy at work: a wrong action is a UserError with the policy's name.

    For the control loop it also plans, one tick at a time, so that the loop never waits for a slow one.
    """

    config = _EveryTick()
    history_ticks = 1

    def __init__(self, policy: Policy, name: str, n_joints: int = ft.N_JOINTS) -> None:
        self._policy, self._name, self._n_joints = policy, name, n_joints

    def reset(self) -> None:
        """Begin an episode."""
        self._policy.reset()

    def act(self, observation: Observation) -> Float32[np.ndarray, " a"]:
        """Return the next action; UserError if not finite or not of the robot's shape."""
        answer = self._policy.act(dict(observation))
        wanted = f"{self._n_joints} joint changes (rad) and the gripper's width (m)"
        try:
            action = np.asarray(answer, np.float32)
        except (TypeError, ValueError):
            raise UserError(f"{self._name}: act gave {answer!r:.60}; return {wanted}") from None
        if action.shape != (self._n_joints + 1,):
            raise UserError(
                f"{self._name}: act gave an array of shape {action.shape}; return {wanted}"
            )
        if not np.isfinite(action).all():
            raise UserError(
                f"{self._name}: act gave {np.round(action, 3).tolist()}; return finite numbers"
            )
        return action

    @property
    def done(self) -> bool:
        """Whether the policy has ended the episode: by an attribute `done`, if it has one."""
        return bool(getattr(self._policy, "done", False))

    def embed(self, observations: Sequence[Observation]) -> None:
        """Do nothing: no work is done ahead."""

    def plan(self, observations: Sequence[Observation]) -> Float32[np.ndarray, "1 a"]:
        """Return the action for the next tick as a plan."""
        return self.act(observations[-1])[None]


@dataclass(frozen=True)
class UserPolicy:
    """Maker of a user's policy for one episode, in any process."""

    name: str  # `module:Class` or `file.py:Class`
    given: Any = None  # the class or an object of it; None: it is imported by its name

    def __call__(self, env: Any = None) -> CheckedPolicy:
        """Make the policy of one episode, for the environment's robot, or an FR3 without one."""
        n_joints = ft.N_JOINTS if env is None else env.n_joints
        policy = CheckedPolicy(self._make(), self.name, n_joints)
        policy.reset()
        return policy

    def env_config(self, config: Config) -> Config:
        """Return the environment's options as the policy's own `env_config` changes them.

        UserError if there is no such class, it lacks a method, or it takes arguments.
        """
        change = getattr(self._make(), "env_config", None)
        return config if change is None else change(config)

    def _make(self) -> Policy:
        found = self._import() if self.given is None else self.given
        for method in ("reset", "act"):
            if not callable(getattr(found, method, None)):
                raise UserError(
                    f"{self.name} has no method {method}: a policy has reset() and act(observation)"
                )
        if not isinstance(found, type):
            return found
        try:
            inspect.signature(found).bind()
        except TypeError as error:
            raise UserError(
                f"{self.name}: {error}; the class is made without arguments, so give them defaults"
            ) from None
        except ValueError:  # no signature, as of a class from C
            pass
        return found()

    def _import(self) -> Any:
        place, _, attribute = self.name.rpartition(":")
        module = _import_file(Path(place)) if place.endswith(".py") else _import(place)
        found = getattr(module, attribute, None)
        if found is None:
            close = get_close_matches(attribute, vars(module), 1)
            guess = f": did you mean {close[0]}?" if close else ""
            raise UserError(f"{place} has no {attribute}{guess}")
        return found


def find_user_policy(name: str, instruction: str = "") -> UserPolicy | PolicyServer | None:
    """Return the policy `module:Class`, `file.py:Class` or `ws://host:port`; None for other names.

    `instruction` is what a server gets where no environment has one.
    """
    if name.startswith(("ws://", "wss://")):
        return PolicyServer(name, instruction)
    _, colon, attribute = name.rpartition(":")
    return UserPolicy(name) if colon and attribute.isidentifier() else None


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

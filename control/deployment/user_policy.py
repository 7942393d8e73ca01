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
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from traceback import walk_tb
from typing import Any

import numpy as np
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation, read_only
from touchgoal.control.interfaces import Planner, Policy
from touchgoal.control.policy_server.policy import ServedPolicy
from touchgoal.runtime.errors import RefusedError, UserError, unknown_name

# Beginnings of files that are not the user's.
_NOT_THEIRS = str(Path(__file__).parents[2]), str(Path(importlib.__file__).parent), "<frozen"


class UserPolicy(Planner):
    """A user's policy at work; on an arm its single tick is a plan, so that the loop never waits for it."""

    def __init__(self, name: str, given: Any = None, env: Any = None) -> None:
        """Make the policy; in an environment its episode begins, else call `reset` before `act`.

        UserError: no such class, it lacks a method, or it takes arguments; here as in the methods,
        a mistake in the user's code, by file and line.

        Args:
            name: `module:Class` or `file.py:Class`, for messages, too.
            given: the class or an object of it; None: it is imported by its name.
            env: environment that it acts in; None: an FR3.
        """
        self._name, self._policy = name, _make(name, _import(name) if given is None else given)
        self._n_joints = ft.N_JOINTS
        if env is not None:
            self._n_joints = env.n_joints
            self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        with _their_mistakes_named(self._name):
            self._policy.reset()

    def act(self, observation: Observation) -> Float32[np.ndarray, " a"]:
        """Return the next action; UserError if not finite or not of the robot's shape."""
        with _their_mistakes_named(self._name, observation):
            answer = self._policy.act(read_only(observation))
        self.done = bool(getattr(self._policy, "done", False))
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

    def plan(self, observations: Sequence[Observation], /) -> Float32[np.ndarray, "1 a"]:
        """Return the action for the next tick as a plan."""
        return self.act(observations[-1])[None]

    def env_config(self, config: Any, /) -> Any:
        """Return the environment's options as the policy's own `env_config` changes them."""
        change = getattr(self._policy, "env_config", None)
        if change is None:
            return config
        with _their_mistakes_named(self._name):
            changed = change(config)
        if not isinstance(changed, type(config)):
            raise UserError(f"{self._name}: env_config gave {changed!r:.60}; return its options")
        return changed


@contextmanager
def _their_mistakes_named(name: str, keys: Iterable[str] = ()) -> Iterator[None]:
    """Raise UserError for an exception of the user's code: file, line, method and what is wrong.

    `name` is the policy's, `keys` are those of the observation it was given.
    """
    try:
        yield
    except RefusedError:
        raise
    except Exception as error:
        where = name
        frames = [(f.f_code, line) for f, line in walk_tb(error.__traceback__)]
        theirs = [f for f in frames if not f[0].co_filename.startswith(_NOT_THEIRS)]
        if theirs:
            code, line = [f for f in theirs if f[0].co_filename == theirs[0][0].co_filename][-1]
            method = "" if code.co_name == "<module>" else f" in {code.co_qualname}"
            where = f"{Path(code.co_filename).name}:{line}{method}"
        what = " ".join(str(error).split())
        if isinstance(error, KeyError) and keys:
            what += f" (the observation has: {', '.join(keys)})"
        kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
        raise UserError(f"{where}: {kind}{what}") from error


def find_user_policy(
    name: str, instruction: str = ""
) -> Callable[..., UserPolicy | ServedPolicy] | None:
    """Return what makes the policy `module:Class`, `file.py:Class` or `ws://host:port` for an episode.

    It takes the environment, or nothing for an arm, in any process. None for other names.
    `instruction` is what a server gets where no environment has one.
    """
    if name.startswith(("ws://", "wss://")):
        return partial(ServedPolicy, name, instruction)
    _, colon, attribute = name.rpartition(":")
    return partial(UserPolicy, name, None) if colon and attribute.isidentifier() else None


def _make(name: str, found: Any) -> Policy:
    for method in ("reset", "act"):
        if not callable(getattr(found, method, None)):
            raise UserError(
                f"{name} has no method {method}: a policy has reset() and act(observation)"
            )
    if not isinstance(found, type):
        return found
    try:
        inspect.signature(found).bind()
    except TypeError as error:
        raise UserError(
            f"{name}: {error}; the class is made without arguments, so give them defaults"
        ) from None
    except ValueError:  # no signature, as of a class from C
        pass
    with _their_mistakes_named(name):
        return found()


def _import(name: str) -> Any:
    place, _, attribute = name.rpartition(":")
    if place.endswith(".py"):
        module = _import_file(Path(place))
    else:
        with _their_mistakes_named(place):
            module = importlib.import_module(place)
    found = getattr(module, attribute, None)
    if found is None:
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        raise unknown_name(f"policy in {place}", attribute, classes)
    return found


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
    try:
        with _their_mistakes_named(path.name):
            spec.loader.exec_module(module)
    except UserError:
        del sys.modules[name]
        raise
    return module

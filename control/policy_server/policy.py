"""A policy that a server computes: `ws://host:port`.

The server answers an observation with `actions` (ticks, joints + 1), in our units (`features.ACTION`),
from that tick on. The first half is executed before the next answer is requested; the second half
bridges a late answer, and when it is used up an arm holds still. All observations are sent under
their own keys, unless the address names some:
`ws://gpu:8000?image=observation.images.front&state=observation.state`. `prompt` is the task's
instruction.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Planner
from touchgoal.runtime.errors import UserError, install_extra


class ServedPolicy(Planner):
    """A served policy at work; a wrong answer is a UserError with the server's address."""

    def __init__(self, address: str, instruction: str = "", env: Any = None) -> None:
        """Connect for the environment's robot, or an FR3 without one; UserError if no server answers.

        `instruction` is sent where no environment gives one.
        """
        try:
            from touchgoal.control.policy_server.connection import Connection
        except ImportError:
            raise UserError(f"a policy server needs {install_extra('server')}") from None
        self._url, _, names = address.partition("?")
        self._names = dict(parse_qsl(names))  # our keys by the server's names; none: all are sent
        self._prompt = instruction if env is None else env.instruction()
        self._width = 1 + (ft.N_JOINTS if env is None else env.n_joints)
        self._connection = Connection(self._url)
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._todo: list[np.ndarray] = []  # actions of the present answer

    def act(self, observation: Observation) -> Float32[np.ndarray, " a"]:
        """Return the action for the next tick."""
        if not self._todo:
            self._todo = list(self.plan([observation])[: self.execution_horizon])
        return self._todo.pop(0)

    def plan(self, observations: Sequence[Observation], /) -> Float32[np.ndarray, "h a"]:
        """Return the server's actions, the first for the latest observation."""
        answer = self._connection.infer(self._message(observations[-1]))
        try:
            actions = np.asarray(answer["actions"], np.float32)
        except (TypeError, KeyError, ValueError):
            raise UserError(f"{self._url} gave no array of actions") from None
        ticks, *width = actions.shape or (0,)
        if not ticks or width != [self._width] or not np.isfinite(actions).all():
            wrong = "not finite" if width == [self._width] else f"of shape {actions.shape}"
            raise UserError(
                f"{self._url} gave actions that are {wrong}; it must give (ticks, {self._width}): "
                f"{self._width - 1} joint changes (rad) and the gripper's width (m)"
            )
        self.execution_horizon = (ticks + 1) // 2
        return actions

    def _message(self, observation: Observation) -> dict[str, Any]:
        names = self._names or {key: key for key in observation}
        if missing := set(names.values()) - set(observation):
            keys = ", ".join(observation)
            raise UserError(f"--policy {self._url}: there is no {min(missing)}, only {keys}")
        return {name: observation[key] for name, key in names.items()} | {"prompt": self._prompt}

    def env_config(self, config: Any, /) -> Any:
        """Return the environment's options with the images that the address names, if it names any."""
        if not (sent := set(self._names.values())):
            return config
        cameras = tuple(key.removeprefix(ft.IMAGE_PREFIX) for key in ft.CAMERAS if key in sent)
        return replace(config, cameras=cameras, tactile=not sent.isdisjoint(ft.TACTILE))

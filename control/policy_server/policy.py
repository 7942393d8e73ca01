"""A policy that a server computes: `ws://host:port`.

The server answers an observation with `actions` (ticks, joints + 1), in our units (`features.ACTION`),
from that tick on. The first half is executed before the next answer is requested; the second half
bridges a late answer, and when it is used up an arm holds still. All observations are sent under
their own keys, unless the address names some:
`ws://gpu:8000?image=observation.images.front&state=observation.state`. `prompt` is the task's
instruction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, TypeVar
from urllib.parse import parse_qsl

import numpy as np
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.runtime.errors import UserError, install_extra

Config = TypeVar("Config")


@dataclass(frozen=True)
class PolicyServer:
    """Maker of a served policy for one episode, in any process."""

    address: str
    instruction: str = ""  # where no environment gives one

    def __call__(self, env: Any = None) -> "ServedPolicy":
        """Connect for the environment's robot, or an FR3 without one; UserError if none answers."""
        if env is None:
            return ServedPolicy(self.address, self.instruction, ft.N_JOINTS)
        return ServedPolicy(self.address, env.instruction(), env.n_joints)

    def env_config(self, config: Config) -> Config:
        """Return the environment's options with the images that the address names, if it names any."""
        if not (sent := set(_names(self.address).values())):
            return config
        cameras = tuple(key.removeprefix(ft.IMAGE_PREFIX) for key in ft.CAMERAS if key in sent)
        tactile = not sent.isdisjoint(ft.TACTILE)
        return replace(config, cameras=cameras, tactile=tactile)  # pyright: ignore


class ServedPolicy:
    """A served policy at work; a wrong answer is a UserError with the server's address."""

    history_ticks = 1

    def __init__(self, address: str, prompt: str, n_joints: int) -> None:
        """Connect; UserError if no policy server answers."""
        try:
            from touchgoal.control.policy_server.connection import Connection
        except ImportError:
            raise UserError(f"a policy server needs {install_extra('server')}") from None
        self._url, self._names, self._prompt = address.partition("?")[0], _names(address), prompt
        self._width, self._connection = n_joints + 1, Connection(self._url)
        # ticks; the executed ones are known from the first answer
        self.config: Any = SimpleNamespace(
            observation_horizon=1, execution_horizon=1, control_hz=ft.CONTROL_HZ
        )
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._todo: list[np.ndarray] = []  # actions of the present answer

    def act(self, observation: Observation) -> Float32[np.ndarray, " a"]:
        """Return the action for the next tick."""
        if not self._todo:
            self._todo = list(self.plan([observation])[: self.config.execution_horizon])
        return self._todo.pop(0)

    def embed(self, observations: Sequence[Observation]) -> None:
        """Do nothing: no work is done ahead."""

    def plan(self, observations: Sequence[Observation]) -> Float32[np.ndarray, "h a"]:
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
        self.config.execution_horizon = (ticks + 1) // 2
        return actions

    def _message(self, observation: Observation) -> dict[str, Any]:
        names = self._names or {key: key for key in observation}
        if missing := set(names.values()) - set(observation):
            keys = ", ".join(observation)
            raise UserError(f"--policy {self._url}: there is no {min(missing)}, only {keys}")
        return {name: observation[key] for name, key in names.items()} | {"prompt": self._prompt}


def _names(address: str) -> dict[str, str]:
    """Return our keys by the server's names; none if all are sent."""
    return dict(parse_qsl(address.partition("?")[2]))

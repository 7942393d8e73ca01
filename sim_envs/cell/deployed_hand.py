"""A Franka Hand behind its driver, inside an environment."""

from typing import Any

import numpy as np

from touchgoal.control.grippers.hand_commands import PERIOD, SHUT, HandCommands, LastCommand

_PERIOD = round(1000 * PERIOD)  # ms
_ARRIVED = 1e-3  # m
_STILL = 2e-4  # m by which fingers move between two looks, and count as stopped
_LEAST = 2  # looks for which any command runs


class DeployedHand:
    """The hand in one episode, open and at rest at first.

    Attributes:
        width: last reading, m.
    """

    def __init__(self, env: Any, rng: np.random.Generator) -> None:
        self._env = env
        self._phase = int(rng.integers(_PERIOD))
        self._goal = self.width = env.width()
        self._commands = HandCommands(self.width)
        self._last: LastCommand = "arrived"
        self._grasps, self._age = False, 0

    def step(self, ms: int, target_width: float) -> float:
        """Return the width (m) that the fingers go to now, given the latest target."""
        if ms % _PERIOD == self._phase:
            self._look(target_width)
        return self._goal

    def _look(self, target_width: float) -> None:
        before, self.width = self.width, self._env.width()
        self._age += 1
        if self._last == "runs" and self._age > _LEAST:
            if abs(self.width - self._goal) < _ARRIVED:
                self._last = "arrived"
            elif abs(self.width - before) < _STILL:
                self._last = "stopped short"
        grasped = self._grasps and self._last != "runs" and self.width > SHUT
        target = min(max(target_width, 0.0), self._env.robot.tool.stroke[1])
        command = self._commands.next(target, self.width, grasped, self._last)
        if command is not None:
            self._grasps = command.grasp
            self._goal = 0.0 if command.grasp else command.width
            self._last, self._age = "runs", 0

"""A Franka Hand behind its driver: one command at a time, as `control/grippers/franka_hand.py` sends them."""

from typing import Any

import numpy as np

_PERIOD = 50  # ms between exchanges with the hand
_SHUT = 2e-3  # m: between commands that differ, and up to which a width means a grasp
_ARRIVED = 1e-3  # m
_STILL = 2e-4  # m by which fingers move in an exchange, and count as stopped
_LEAST = 2  # exchanges that any command takes


class DeployedHand:
    """The hand in one episode, open and at rest at first.

    A move runs to its end before the next command is looked at; closing to 0 grasps: it goes on
    until it meets something, and then holds by force. A move inwards that is stopped grasps, too.

    Attributes:
        width: as last read, m.
    """

    def __init__(self, env: Any, rng: np.random.Generator) -> None:
        self._env = env
        self._phase = int(rng.integers(_PERIOD))
        self._sent = self._goal = env.width()
        self.width = env.width()
        self._busy, self._age = False, 0

    def step(self, ms: int, wanted: float) -> float:
        """The width (m) that the fingers go to in this millisecond, while `wanted` is the newest."""
        if ms % _PERIOD == self._phase:
            self._exchange(wanted)
        return self._goal

    def _exchange(self, wanted: float) -> None:
        before, self.width = self.width, self._env.width()
        self._age += 1
        if self._busy and self._age > _LEAST:
            arrived = abs(self.width - self._goal) < _ARRIVED
            stopped = abs(self.width - before) < _STILL
            if stopped and not arrived and self._goal < self.width:
                self._goal = 0.0  # what a move meets on its way in is grasped
            self._busy = not (arrived or stopped)
        if not self._busy and abs(wanted - self._sent) > _SHUT:
            self._sent = wanted
            holds = self._goal == 0.0 and self.width > _SHUT
            if holds and wanted < self.width:
                return  # the grasp goes on
            self._goal = 0.0 if wanted <= _SHUT else wanted
            self._busy, self._age = True, 0

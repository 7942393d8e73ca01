"""Keyboard teleoperation of the bead, as if guiding a compliant arm by hand.

A key pushes the hand; the arm yields to the wire's forces on the bead.
"""

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.motion.rotations import rotation_matrix
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import TeleoperatorConfig

STOP = " "
HELP = "w/s on/back  a/d left/right  r/f up/down  j/l yaw  i/k pitch  u/o roll  space stop"

# A pair an axis of the hand (x along the wire, y right, z down): the key that pushes or turns
# the hand, and the key that does the opposite.
_PAIRS = ("ws", "da", "fr", "ou", "ik", "lj")
_PUSHES = {
    key: sign * axis
    for pair, axis in zip(_PAIRS, np.eye(6), strict=True)
    for key, sign in zip(pair, (1, -1), strict=True)
}


class Teleoperator:
    """Turns pressed keys into actions of a compliant hand."""

    def __init__(self, env: BeadMaze, config: TeleoperatorConfig) -> None:
        self._env, self._config = env, config
        self._held: dict[str, int] = {}  # ticks left

    @property
    def held(self) -> str:
        """Keys that count as held."""
        return "".join(sorted(self._held))

    def press(self, keys: str) -> None:
        """Take typed keys, in this order; ignore keys without a meaning."""
        for key in keys:
            if key == STOP:
                self._held.clear()
            elif key in _PUSHES:
                (pair,) = (pair for pair in _PAIRS if key in pair)
                self._held.pop(pair.replace(key, ""), None)
                self._held[key] = round(self._config.hold_seconds * self._env.config.control_hz)

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action for the next tick; none while the hand closes on the bead."""
        env, c = self._env, self._config
        push = sum((_PUSHES[key] for key in self._held), np.zeros(6)).reshape(2, 3)
        self._held = {key: ticks - 1 for key, ticks in self._held.items() if ticks > 1}
        if env.grasping:
            return np.zeros(env.n_joints + 1)
        position, R = env.kinematics.forward(env.command)
        wrench = observation[ft.WRENCH].astype(np.float64).reshape(2, 3)
        moved, turned = np.array([[c.speed], [c.turn_speed]]) * (push @ R.T)
        yielded, swung = np.array([[c.compliance], [c.rotational_compliance]]) * wrench
        tick = 1 / env.config.control_hz
        target = position + tick * (moved + yielded)
        R = rotation_matrix(tick * (turned + swung)) @ R
        joints = env.kinematics.solve_ik_near(target, R, env.command).q
        return np.append(joints - env.command, 0.0)

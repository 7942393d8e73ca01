"""The demonstrator of fragile-carry: it squeezes harder the farther the rod has slipped."""

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.rotations import fingers_down, rotation_vector
from touchgoal.sim_envs import fragile_carry

_FIRST_FORCE = 0.7  # N of each finger, too light for every rod
_SLIP_PER_E = 2e-3  # m of slip after which the force is e times as large
_RESERVE = 1.5  # factor of the force once the rod is in the air
_MAX_FORCE = 16.0  # N
_LEVER = 0.010  # m, half the pad's width, by which a turn slips at the pad's edge
_TOP = 0.03  # m of lift
_SLOW_LIFT = 0.010  # m of lift in which the rod may slip while its rests still carry it
_LIFT, _FAST, _ACROSS = 0.01, 0.1, 0.15  # m/s
_RETURN = 5.0  # 1/s: decay of a deviation, and speed per distance that is left
_OVER = 0.003  # m beside the goal within which the rod is lowered


class FragileCarryExpert(Actor):
    """Lifts slowly, tightens as the rod slips, holds a reserve, and lowers the rod onto the rests.

    It acts on the present state alone, so that it can correct a policy anywhere. Of the truth it
    uses how far the rod has slipped, which fingertips can feel, not the force that holds.
    """

    def __init__(self, env: fragile_carry.FragileCarry) -> None:
        self._env = env

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """Return the action for the next tick; the observation is not used."""
        env = self._env
        position, R = env.kinematics.forward(env.command)
        place = position - [
            fragile_carry.START[0] + fragile_carry.GRIP_OFFSET,
            fragile_carry.START[1],
            fragile_carry.LEVEL + fragile_carry.GRIP_HEIGHT,
        ]
        change = np.zeros(6)
        if min(pad.normal_force for pad in env.pad_contacts()) > _FIRST_FORCE / 2:
            turn = R @ rotation_vector(R.T @ fingers_down(0.0))
            change = np.append(_velocity(place), _RETURN * turn) / env.config.control_hz
        width = fragile_carry.width_for(self._force(place[2]))
        return np.append(env.kinematics.joint_change(env.command, change), width)

    def _force(self, rise: float) -> float:
        """Return the force (N) of each finger for the slip so far, `rise` m above the start."""
        slide, tilt = self._env.in_hand()
        slip = abs(slide) + _LEVER * abs(tilt)
        reserve = 1 + (_RESERVE - 1) * np.clip(rise / _SLOW_LIFT - 1, 0, 1)
        return min(float(_FIRST_FORCE * np.exp(slip / _SLIP_PER_E) * reserve), _MAX_FORCE)


def _velocity(place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the hand's velocity (m/s) up, across and down, `place` m from where it gripped."""
    rise, left = place[2], fragile_carry.GOAL[1] - fragile_carry.START[1] - place[1]
    back = -_RETURN * place[0]
    if left < _OVER:
        down = min(_FAST, _LIFT + _RETURN * max(rise - 0.003, 0.0)) if rise > 0 else 0.0
        return np.array([back, _RETURN * left, -down])
    if rise > 0.8 * _TOP:
        begun = 0.03 + 2 * _RETURN * max(place[1], 0.0)
        return np.array([back, min(_ACROSS, begun, 0.01 + _RETURN * left), _RETURN * (_TOP - rise)])
    up = min(_FAST, _LIFT + _RETURN * max(rise - _SLOW_LIFT, 0.0))
    return np.array([back, -_RETURN * place[1], up])

"""Classical baseline of the bead maze: yield to the wire's force, go on the way the hand has moved."""

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.rotations import fingers_across
from touchgoal.control.safety.limits import FR3

GRASP_SECONDS = 0.5  # s for which the hand closes on the bead before it moves
# Gains, chosen on validation wires.
_SPEED = 0.025  # along the wire, m/s
# Speed of the hand per force across the wire, m/s per N; above 1/(stiffness x lag) of arm and gel it
# oscillates.
_COMPLIANCE = 2e-3
_MEMORY = 0.25  # time constant of the averaged direction of motion, s
_LEAD = 0.006  # largest distance between commanded and measured position, m


class WireFollower(Actor):
    """Actor that follows an unknown wire from force and joint positions; it never ends by itself.

    It waits while the hand closes, and starts along the hand's x axis, which must lie along the
    wire. Compliance across a constraint and motion along it are Mason's (1981).
    """

    def __init__(self, control_hz: int = ft.CONTROL_HZ) -> None:
        self._tick = 1 / control_hz
        self._kinematics = FR3.kinematics()
        self._command: np.ndarray | None = None
        self._grasping = round(GRASP_SECONDS * control_hz)

    def act(self, observation: Observation) -> np.ndarray:
        """Return the action for the next tick."""
        if self._grasping > 0:
            self._grasping -= 1
            return np.zeros(8)
        tick = self._tick
        joints = observation[ft.STATE][:7].astype(np.float64)
        position, R = self._kinematics.forward(joints)
        if self._command is None:
            self._command, self._target, self._before = joints, position, position
            self._velocity = _SPEED * R[:, 0]
        share = tick / _MEMORY
        self._velocity += share * ((position - self._before) / tick - self._velocity)
        self._before = position
        heading = self._velocity / np.linalg.norm(self._velocity)
        force = observation[ft.WRENCH][:3]
        across = force - heading * (heading @ force)
        self._target = self._target + tick * (_SPEED * heading + _COMPLIANCE * across)
        lag = self._target - position
        self._target = position + lag * min(1.0, _LEAD / max(np.linalg.norm(lag), 1e-9))
        R = fingers_across(heading)
        wanted = self._kinematics.solve_ik_near(self._target, R, self._command).q
        action = np.append(wanted - self._command, 0.0)
        self._command = wanted
        return action

"""The bead maze's classical baseline: yield to the wire's force, turn to where the hand has moved."""

from dataclasses import dataclass

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.motion.kinematics import Fr3Kinematics
from touchgoal.control.motion.rotations import fingers_across
from touchgoal.sim_envs.bead_maze import GRASP_SECONDS


@dataclass(frozen=True)
class FollowerConfig:
    """Gains, chosen on validation wires.

    Attributes:
        speed: along the wire, m/s.
        compliance: speed at which the hand gives way to a force across the wire, m/s per N; more
            than 1/(stiffness x lag) of arm and gel swings.
        memory: time over which the direction of motion is averaged, s.
        lead: how far the commanded position may be from the measured one, m.
    """

    speed: float = 0.025
    compliance: float = 2e-3
    memory: float = 0.25
    lead: float = 0.006


class WireFollower:
    """Follows a wire that it does not know, from force and joint positions.

    While the hand closes it waits. It starts along the hand's x axis, which whoever put the bead into the hand has laid along the
    wire. Compliance across a constraint and motion along it are Mason's (1981).
    """

    def __init__(self, control_hz: int = ft.CONTROL_HZ, config: FollowerConfig | None = None):
        self._tick = 1 / control_hz
        self._config = config or FollowerConfig()
        self._kinematics = Fr3Kinematics()
        self._command: np.ndarray | None = None
        self._grasping = round(GRASP_SECONDS * control_hz)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """The action for the next tick, from joint positions and the external force."""
        if self._grasping > 0:
            self._grasping -= 1
            return np.zeros(8)
        config, tick = self._config, self._tick
        joints = observation[ft.STATE][:7].astype(np.float64)
        position, R = self._kinematics.forward(joints)
        if self._command is None:
            self._command, self._target, self._before = joints, position, position
            self._velocity = config.speed * R[:, 0]
        share = tick / config.memory
        self._velocity += share * ((position - self._before) / tick - self._velocity)
        self._before = position
        heading = self._velocity / np.linalg.norm(self._velocity)
        force = observation[ft.WRENCH][:3]
        across = force - heading * (heading @ force)
        self._target = self._target + tick * (config.speed * heading + config.compliance * across)
        lag = self._target - position
        self._target = position + lag * min(1.0, config.lead / max(np.linalg.norm(lag), 1e-9))
        wanted = self._kinematics.solve_ik_near(
            self._target, fingers_across(heading), self._command
        ).q
        action = np.append(wanted - self._command, 0.0)
        self._command = wanted
        return action

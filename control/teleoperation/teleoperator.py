"""The actor of a teleoperated run: the device's motion, and a hand that yields to what it presses on.

Its actions pass the control loop's safety layer like any policy's."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.rotations import rotation_matrix
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.teleoperation.device import TeleoperationConfig, TeleoperationDevice

# Speed per force and turning speed per torque at which the hand yields, m/s per N beyond 3 N and rad/s
# per Nm beyond 0.3 Nm; much more oscillates.
_COMPLIANCE = 2e-3, 0.5
_FREE_FORCE = 3.0  # N beyond the first reading that count as none: the weight of a carried object


class Compliance:
    """Velocity with which the hand gives way to forces beyond those at rest."""

    def __init__(self, factor: float, free_torque: float) -> None:
        """Yield `factor` times as much as a led hand; a change of up to `free_torque` (Nm) is none."""
        self._linear, self._angular = (factor * gain for gain in _COMPLIANCE)
        self._free_torque = free_torque

    def start(self, observation: Observation) -> None:
        """Take the wrench as that of the free hand."""
        self._at_rest = observation[ft.WRENCH].astype(np.float64)

    def velocity(self, observation: Observation) -> Float[np.ndarray, "6"]:
        """Return the hand's velocity, base frame (m/s, rad/s); none where the wrench is unknown."""
        force, torque = (observation[ft.WRENCH] - self._at_rest).reshape(2, 3)
        moved = self._linear * _beyond(force, _FREE_FORCE)
        return np.concatenate([moved, self._angular * _beyond(torque, self._free_torque)])


def _beyond(vector: Float[np.ndarray, "3"], free: float) -> Float[np.ndarray, "3"]:
    """Return a vector shortened by `free`; NaN, as near an arm's singularity, counts as none."""
    length = float(np.linalg.norm(vector))
    return vector * (1 - free / length) if length > free else np.zeros(3)


# Nm. The drift of an arm's own estimate passes it and turns the hand a little, which is corrected: of
# recordings without that, policies learned to hover above what they are to grasp.
_FREE_TORQUE = 0.3


class Teleoperator(Actor):
    """Moves the commanded hand by a device's motions; it never ends by itself."""

    def __init__(
        self,
        device: TeleoperationDevice,
        safety: ActionFilter,
        commanded: Callable[[], np.ndarray],
        config: TeleoperationConfig,
    ) -> None:
        """Begin at rest; `commanded` returns the joints (rad) commanded now."""
        self._device, self._commanded, self._config = device, commanded, config
        self._kinematics = safety.limits.kinematics()
        self._widths = {"close": safety.limits.tool.stroke[0], "open": safety.limits.tool.stroke[1]}
        self._compliance = Compliance(1, _FREE_TORQUE)
        self._dt = safety.dt

    def start(self, observation: Observation) -> None:
        """Take the first wrench as that of the free hand, and the gripper's width as its target."""
        self._compliance.start(observation)
        self._width = float(observation[ft.STATE][-1])

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """Return the action for the next tick; joints stand where the arm cannot follow."""
        motion, config, q = self._device.read(observation), self._config, self._commanded()
        self._width = self._widths.get(motion.gripper, self._width)
        yielded = self._compliance.velocity(observation)
        moved = config.speed * motion.twist[:3] + yielded[:3]
        turned = config.turn_speed * motion.twist[3:] + yielded[3:]
        if not moved.any() and not turned.any():
            return np.append(np.zeros(q.size), self._width)
        position, R = self._kinematics.forward(q)
        R = rotation_matrix(self._dt * turned) @ R
        solved = self._kinematics.solve_ik_near(position + self._dt * moved, R, q)
        return np.append(solved.q - q if solved.reached else np.zeros(q.size), self._width)


_MORE = 2  # times as much as a led hand: a policy sees where to stop less well than the person who led it

# Nm. More than for a led hand: a policy does not correct the slow turn that an estimate's drift causes.
_UNCORRECTED_TORQUE = 0.6


class YieldingHand(Compliance):
    """Adds to a policy's actions the motion with which a hand yields, twice that of a led one.

    The policy learned from demonstrations in which it did; without it the hand presses harder.
    """

    def __init__(self, safety: ActionFilter, commanded: Callable[[], np.ndarray]) -> None:
        """Get ready; `commanded` returns the joints (rad) commanded now."""
        self._commanded, self._dt = commanded, safety.dt
        self._kinematics = safety.limits.kinematics()
        super().__init__(_MORE, _UNCORRECTED_TORQUE)

    def add_to(
        self, action: Float[np.ndarray, " n"], observation: Observation
    ) -> Float[np.ndarray, " n"]:
        """Return the action of this tick with the yielding added."""
        velocity = self.velocity(observation)
        if not velocity.any():
            return action
        change = self._kinematics.joint_change(self._commanded(), self._dt * velocity)
        return np.append(action[:-1] + change, action[-1])

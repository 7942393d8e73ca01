"""A hand that yields to what a policy presses it on, as the led hand of demonstrations does."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import Observation
from touchgoal.control.motion.compliance import Compliance
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.teleoperation.config import COMPLIANCE

_MORE = 2  # times as much as a led hand: a policy sees where to stop less well than the person who led it

# Nm. More than for a led hand: a policy does not correct the slow turn that an estimate's drift causes.
_FREE_TORQUE = 0.6


class YieldingHand:
    """Adds to a policy's actions the motion with which a hand yields, twice that of a led one.

    The policy learned from demonstrations in which it did; without it the hand presses harder.
    """

    def __init__(self, safety: ActionFilter, commanded: Callable[[], np.ndarray]) -> None:
        """Get ready; `commanded` returns the joints (rad) commanded now."""
        self._commanded, self._dt = commanded, safety.dt
        self._kinematics = Kinematics(safety.limits.arm, safety.limits.tool.tcp_offset)
        linear, angular = COMPLIANCE
        self._compliance = Compliance(_MORE * linear, _MORE * angular, _FREE_TORQUE)

    def start(self, observation: Observation) -> None:
        """Take the wrench as that of the free hand."""
        self._compliance.start(observation)

    def add_to(
        self, action: Float[np.ndarray, " n"], observation: Observation
    ) -> Float[np.ndarray, " n"]:
        """Return the action of this tick with the yielding added."""
        velocity = self._compliance.velocity(observation)
        if not velocity.any():
            return action
        change = self._kinematics.joint_change(self._commanded(), self._dt * velocity)
        return np.append(action[:-1] + change, action[-1])

"""An actor whose hand yields to what it presses on, as the led hand of demonstrations does."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.compliance import Compliance
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.teleoperation.config import COMPLIANCE

_MORE = 2  # times as much as a led hand: a policy sees where to stop less well than the person who led it

# Nm. More than for a led hand: a policy does not correct the slow turn that an estimate's drift causes.
_FREE_TORQUE = 0.6


class YieldingActor(Actor):
    """Adds to another actor's actions the motion with which a hand yields, twice that of a led one.

    The policy learned from demonstrations in which it did; without it the hand presses harder.
    """

    def __init__(
        self, actor: Actor, safety: ActionFilter, commanded: Callable[[], np.ndarray]
    ) -> None:
        """Take an actor; `commanded` returns the joints (rad) commanded now."""
        self._actor, self._commanded, self._dt = actor, commanded, safety.dt
        self._kinematics = Kinematics(safety.limits.arm, safety.limits.tool.tcp_offset)
        linear, angular = COMPLIANCE
        self._compliance = Compliance(_MORE * linear, _MORE * angular, _FREE_TORQUE)

    def start(self, observation: Observation) -> None:
        """See Actor; the first wrench is that of the free hand."""
        self._compliance.start(observation)
        self._actor.start(observation)

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """See Actor."""
        action = self._actor.act(observation)
        self.done, self.action_age = self._actor.done, self._actor.action_age
        velocity = self._compliance.velocity(observation)
        if not velocity.any():
            return action
        change = self._kinematics.joint_change(self._commanded(), self._dt * velocity)
        return np.append(action[:-1] + change, action[-1])

    def close(self) -> None:
        """See Actor."""
        self._actor.close()

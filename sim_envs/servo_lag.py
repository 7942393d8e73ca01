"""The lag of the environment's servo, put back where an arm follows its set-points at once."""

import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.tracker import Tracker
from touchgoal.control.safety.limits import RobotLimits
from touchgoal.sim_envs.scene.build import SERVO_DAMPING

Joints = Float[np.ndarray, " n"]


class ServoLag:
    """Passes joint changes on as late as the environment's servo would: a lag of the first order.

    The tracker's own lag counts as a part of it.

    Attributes:
        remaining: rad, wanted and not yet passed on.
    """

    def __init__(self, robot: RobotLimits, dt: float) -> None:
        """For a robot and a tick of `dt` s."""
        tracker = Tracker(robot.interface, robot.policy.velocity, dt)
        self._share = 1 - float(np.exp(-dt / (SERVO_DAMPING - tracker.lag)))
        self.remaining = np.zeros(robot.arm.home.size)

    def update(self, delta: Joints) -> Joints:
        """The part (rad) of what remains, with this tick's joint change (rad), that is passed on."""
        self.remaining = self.remaining + delta
        step = self._share * self.remaining
        self.remaining = self.remaining - step
        return step

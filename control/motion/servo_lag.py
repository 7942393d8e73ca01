"""First-order lag of the simulated servo that policies learn on, for arms that follow at once."""

import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.tracker import Tracker
from touchgoal.control.safety.limits import RobotLimits

SERVO_DAMPING = 0.1  # s: N m s/rad for each N m/rad of stiffness, as in Franka's fr3.xml

Joints = Float[np.ndarray, " n"]


class ServoLag:
    """Delays joint changes as the simulated servo does, less the tracker's own lag.

    Attributes:
        remaining: joint change asked for and not yet passed on, rad.
    """

    def __init__(self, robot: RobotLimits, dt: float) -> None:
        """Begin at rest, with control ticks of `dt` s."""
        tracker = Tracker(robot.interface, robot.policy.velocity, dt)
        self._share = 1 - float(np.exp(-dt / (SERVO_DAMPING - tracker.lag)))
        self.remaining = np.zeros(robot.arm.home.size)

    def update(self, delta: Joints) -> Joints:
        """Add this tick's joint change (rad) and return the part (rad) to command now."""
        self.remaining = self.remaining + delta
        step = self._share * self.remaining
        self.remaining = self.remaining - step
        return step

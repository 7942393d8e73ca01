"""The lag of the environment's servo, put back where an arm follows its set-points at once."""

import numpy as np
from jaxtyping import Float

from touchgoal.sim_envs.scene.build import SERVO_DAMPING

Joints = Float[np.ndarray, " n"]


class ServoLag:
    """Passes joint changes on as late as the environment's servo would: a lag of the first order.

    Attributes:
        remaining: rad, wanted and not yet passed on.
    """

    def __init__(self, dt: float, n: int) -> None:
        """For a tick of `dt` s and n joints."""
        self._share = 1 - float(np.exp(-dt / SERVO_DAMPING))
        self.remaining = np.zeros(n)

    def update(self, delta: Joints) -> Joints:
        """The part (rad) of what remains, with this tick's joint change (rad), that is passed on."""
        self.remaining = self.remaining + delta
        step = self._share * self.remaining
        self.remaining = self.remaining - step
        return step

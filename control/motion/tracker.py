"""From a policy's 10 to 20 Hz to a 1 kHz interface: smooth, inside all limits, never beyond.

Three stages a millisecond. A reference walks in a straight line to each new target within the
policy's period. A follower approaches it as fast as velocity and acceleration let it and always
able to stop there, so it never overshoots. A short mean over the follower's positions bounds the
jerk; a mean never leaves the range of what it averages, nor do its speed and acceleration. A late
target needs no case of its own: the reference has arrived and the follower stops there.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.arm_models import JointLimits
from touchgoal.control.safety.braking import max_stoppable_speed

Joints = Float[np.ndarray, "n"]


@dataclass(frozen=True)
class TrackerState:
    """One millisecond of the tracker.

    Attributes:
        q: commanded joint positions, rad.
        reference: where the straight line to the target is, rad.
        target: the policy's last target, rad.
        reference_step: rad a millisecond of the reference.
        velocity: of the follower, rad/s.
        window: the follower's last positions, oldest first, rad.
    """

    q: Joints
    reference: Joints
    target: Joints
    reference_step: Joints
    velocity: Joints
    window: Float[np.ndarray, "m n"]


class Tracker:
    """Inside `limits` for targets that come every `period` s; `dt` s is the interface's tick.

    Give it `RobotLimits.interface`. Joints lag by themselves, so the path between two targets is
    not quite straight: behind the safety layer the fingers then leave the box by up to 1 mm;
    inside `RobotLimits.policy` it would be 6 mm.
    """

    def __init__(self, limits: JointLimits, period: float, dt: float = 1e-3) -> None:
        self.limits, self.dt = limits, dt
        self._ticks = round(period / dt)
        # Of a mean over m ticks the acceleration changes by at most 2 a / m in one.
        self._window = max(1, int(np.ceil((2 * limits.acceleration / limits.jerk / dt).max())))

    def start(self, q: Joints) -> TrackerState:
        """At rest in `q` (rad)."""
        still = np.zeros(q.size)
        return TrackerState(q, q, q, still, still, np.tile(q, (self._window, 1)))

    def set_target(self, state: TrackerState, target: Joints) -> TrackerState:
        """A new target (rad) from the policy, clamped to the limits; not a number: it is left out.

        It is to be reached one period from now, or as soon after as the limits allow.
        """
        if not np.isfinite(target).all():
            return state
        target = np.clip(target, self.limits.lower, self.limits.upper)
        return replace(
            state, target=target, reference_step=np.abs(target - state.reference) / self._ticks
        )

    def step(self, state: TrackerState) -> TrackerState:
        """One tick of the interface; `q` of the result is the command."""
        limits, dt = self.limits, self.dt
        left = state.target - state.reference
        reference = state.reference + np.clip(left, -state.reference_step, state.reference_step)
        last = state.window[-1]
        gap = reference - last
        speed = np.minimum(
            max_stoppable_speed(np.abs(gap), limits.acceleration, dt), limits.velocity
        )
        reach = limits.acceleration * dt
        wanted = np.sign(gap) * speed
        velocity = np.clip(wanted, state.velocity - reach, state.velocity + reach)
        window = np.vstack([state.window[1:], last + velocity * dt])
        q = window.mean(axis=0)
        return replace(state, q=q, reference=reference, velocity=velocity, window=window)

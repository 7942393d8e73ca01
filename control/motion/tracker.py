"""Tracker that turns a policy's targets (10 to 20 Hz) into a smooth 1 kHz stream inside all limits.

A reference walks in straight lines from target to target, each within the policy's period, or
slower where it would turn faster than the limits allow. The command is the reference's mean over a
short window: it stays in the reference's range and delays all joints alike. It cuts corners, which
`SafetyLimits.reserve` allows for.
"""

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from touchgoal.control.motion.arm_models import JointLimits, Joints
from touchgoal.control.safety.limits import RobotLimits

SERVO_DAMPING = 0.1  # s: damping over stiffness, as in Franka's fr3.xml
_RESERVE = 1.1  # factor on the targets' pace by which the reference may catch up
_ROUNDING = 1e-12  # rad
_MOST = 8  # queued targets; more mean a clock faster than the policy's: the queue is dropped


@dataclass(frozen=True)
class TrackerState:
    """State of the tracker at one millisecond."""

    q: Joints  # commanded joint positions, rad
    # targets: the reference's next ones, rad; step: its motion in a millisecond at their pace, rad
    targets: Float[np.ndarray, "k n"]
    step: Joints
    window: Float[np.ndarray, "m n"]  # the reference's last positions, oldest first, rad


class Tracker:
    """Tracker inside `limits` for targets every `period` s; `dt` s is the interface's tick.

    Pass `RobotLimits.interface`, and as `speed` (rad/s) the highest speed of targets,
    `RobotLimits.policy`'s; with targets over a tenth faster the reference falls behind. `lag` is
    the delay of the command behind the reference, s.
    """

    def __init__(self, limits: JointLimits, speed: Joints, period: float, dt: float = 1e-3) -> None:
        self.limits = limits
        self._ticks = round(period / dt)
        # The mean over m ticks accelerates by (u - u_m) / m, with the reference's speed u and that
        # of m ticks before: from full speed to rest within the limits.
        self._m = int(np.ceil((_RESERVE * speed / limits.acceleration / dt).max()))
        # A mean of k such means changes its acceleration by at most 2 a / k in a tick.
        k = max(1, int(np.ceil((2 * limits.acceleration / limits.jerk / dt).max())))
        self._weights = np.convolve(np.full(self._m, 1 / self._m), np.full(k, 1 / k))
        self.lag = (self._weights.size - 1) / 2 * dt
        # rad per tick: largest change of the reference's step over the window
        self._reach = limits.acceleration * self._m * dt**2
        self._fastest = np.minimum(limits.velocity * dt, self._reach)
        self.step(self.start(speed))  # compiles now, not in a loop

    def start(self, q: Joints) -> TrackerState:
        """Return the state at rest in `q` (rad)."""
        window = np.tile(q, (max(self._weights.size, self._m + 1), 1))
        return TrackerState(q, np.empty((0, q.size)), np.zeros(q.size), window)

    def set_target(self, state: TrackerState, target: Joints) -> TrackerState:
        """Add a target (rad) one period after the last, or as soon after as the limits allow.

        It is clamped to the limits; NaN is left out.
        """
        if not np.isfinite(target).all():
            return state
        target = np.clip(target, self.limits.lower, self.limits.upper)
        reference, waiting = state.window[-1], len(state.targets)
        if np.array_equal(state.targets[-1] if waiting else reference, target):
            return state
        if 0 < waiting < _MOST:
            return replace(state, targets=np.vstack([state.targets, target]))
        return replace(state, targets=target[None], step=(target - reference) / self._ticks)

    def step(self, state: TrackerState) -> TrackerState:
        """Return the state after one tick of the interface; its `q` is the command."""
        fixed = self._weights, self._m, self._reach, self._fastest, self._ticks
        return TrackerState(*_step(state.targets, state.step, state.window, *fixed))


class ServoLag:
    """Delay of the simulated servo that policies learn on, less the tracker's own.

    `remaining` is the joint change asked for and not yet passed on, rad.
    """

    def __init__(self, robot: RobotLimits, dt: float) -> None:
        tracker = Tracker(robot.interface, robot.policy.velocity, dt)
        self._share = 1 - float(np.exp(-dt / (SERVO_DAMPING - tracker.lag)))
        self.remaining = np.zeros(robot.arm.home.size)

    def update(self, delta: Joints) -> Joints:
        """Add this tick's joint change (rad) and return the part (rad) to command now."""
        self.remaining = self.remaining + delta
        step = self._share * self.remaining
        self.remaining = self.remaining - step
        return step


@njit(cache=True)
@no_type_check
def _step(targets, step, window, weights, m, reach, fastest, ticks):
    """Return the command, the remaining targets, the reference's step and its window."""
    reference = window[-1].copy()
    if len(targets):
        # steps that the reference may go while its mean stays in the limits
        pace = float(len(targets))
        for i in range(step.size):
            if step[i] != 0:
                before = window[-m, i] - window[-m - 1, i]
                most = min(abs(before + np.sign(step[i]) * reach[i]), fastest[i])
                pace = min(pace, most / abs(step[i]))
        if (np.abs(targets[0] - reference) <= pace * np.abs(step) + _ROUNDING).all():
            reference, targets = targets[0].copy(), targets[1:]
            step = (targets[0] - reference) / ticks if len(targets) else np.zeros(step.size)
        else:
            reference += pace * step
    moved = np.empty_like(window)
    moved[:-1] = window[1:]
    moved[-1] = reference
    q = np.zeros(step.size)
    for k in range(weights.size):
        q += weights[k] * moved[k - weights.size]
    return q, targets, step, moved

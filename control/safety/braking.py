"""Highest joint speed that still stops in time, exact for a command that changes once a tick."""

import numpy as np
from jaxtyping import Float

Joints = Float[np.ndarray, "*k joints"]
PerJoint = Float[np.ndarray, " joints"]


def max_stoppable_speed(gap: Joints, acceleration: PerJoint, dt: float) -> Joints:
    """Return the highest speed (rad/s) for this tick that still brakes to rest within `gap` (rad).

    Braking takes `acceleration * dt` off the speed each tick of `dt` s. In these units speed u
    with n = floor(u) travels (n + 1) u - n (n + 1) / 2; this inverts it. Zero for no gap. Keeping
    to it is always possible: one tick of braking from an allowed speed is allowed again.
    """
    unit = acceleration * dt
    g = np.maximum(gap, 0) / (unit * dt)
    n = np.floor((np.sqrt(1 + 8 * g) - 1) / 2)
    return unit * (g + n * (n + 1) / 2) / (n + 1)


def braked_velocity(velocity: Joints, acceleration: PerJoint, dt: float) -> Joints:
    """Return the velocity (rad/s) after one tick of braking, each joint by itself."""
    return velocity - np.clip(velocity, -acceleration * dt, acceleration * dt)

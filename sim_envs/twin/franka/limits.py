"""Limits of the Franka control interface: set-points, arm, contact."""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from touchgoal.control.safety.limits import FR3
from touchgoal.sim_envs.cell.simulated_cell import DT
from touchgoal.sim_envs.twin.franka.messages import COLLISION_BEHAVIOUR

Joints = Float[np.ndarray, "7"]
Wrench = Float[np.ndarray, "6"]

_SLACK = 1.01  # for the wire's rounding
_STEADY = 0.1  # rad/s^2: below it the thresholds for nominal motion hold
# Singular value of the Jacobian below which the arm gives no wrench; our choice.
_SINGULAR = 0.02
_DAMPING = 1e-8  # m^2: makes the wrench at a singular pose finite
_NEVER_ZERO = 1e-6  # N: a measured estimate is never exactly 0


_TAPER = FR3.hardware.taper
assert _TAPER is not None  # the FR3's speeds shrink near the ends of its ranges
_HARDWARE = (
    *(FR3.hardware.lower, FR3.hardware.upper, FR3.hardware.velocity),
    *(FR3.hardware.acceleration, FR3.hardware.jerk),
    *(_TAPER.gain, _TAPER.lower, _TAPER.upper, _TAPER.offset),
)


@dataclass(frozen=True)
class Setpoint:
    """A joint set-point with its derivatives: rad, rad/s, rad/s^2."""

    q: Joints
    dq: Joints
    ddq: Joints


def next_setpoint(before: Setpoint, q: Joints) -> Setpoint:
    """Return the set-point a millisecond later at `q`, with its derivatives."""
    dq = (q - before.q) / DT
    return Setpoint(q, dq, (dq - before.dq) / DT)


def joint_fault(before: Setpoint, now: Setpoint) -> str | None:
    """Return libfranka's name of the limit that a set-point breaks; None if none."""
    broken = _broken_limit(now.q, now.dq, now.ddq, before.ddq, *_HARDWARE)
    return None if broken < 0 else f"joint_motion_generator_{_LIMITS[broken]}"


_LIMITS = (
    "position_limits_violation",
    "velocity_limits_violation",
    "velocity_discontinuity",
    "acceleration_discontinuity",
)


@njit(cache=True)
@no_type_check
def _broken_limit(
    q, dq, ddq, ddq_before, lower, upper, velocity, acceleration, jerk, gain, below, above, offset
):
    """Return the first of `_LIMITS` that a joint breaks, or -1; see `JointLimits.speed_range`."""
    worst = len(_LIMITS)
    for i in range(len(q)):
        up = np.sqrt(max(gain[i] * (above[i] - q[i]), 0.0)) - offset[i]
        down = np.sqrt(max(gain[i] * (q[i] - below[i]), 0.0)) - offset[i]
        highest, lowest = min(max(up, 0.0), velocity[i]), -min(max(down, 0.0), velocity[i])
        outward = dq[i] if q[i] > upper[i] else -dq[i] if q[i] < lower[i] else 0.0
        if not np.isfinite(q[i]) or outward > 1e-3:
            worst = 0
        elif dq[i] > _SLACK * highest + 1e-3 or dq[i] < _SLACK * lowest - 1e-3:
            worst = min(worst, 1)
        elif abs(ddq[i]) > _SLACK * acceleration[i]:
            worst = min(worst, 2)
        elif abs(ddq[i] - ddq_before[i]) > _SLACK * DT * jerk[i]:
            worst = min(worst, 3)
    return worst if worst < len(_LIMITS) else -1


def arm_fault(excess: float, speed: float) -> str | None:
    """Return a fault if a joint is beyond its range (rad), or too fast (share of its speed)."""
    if excess > 0.01:
        return "joint_position_limits_violation"
    return "joint_velocity_violation" if speed > 1.1 else None


def estimate_sent(wrench: Wrench, jacobian: Float[np.ndarray, "6 7"]) -> Wrench:
    """Return O_F_ext_hat_K: the robot's wrench (N, Nm) on the environment; 0 at a singularity."""
    singular = np.linalg.eigvalsh(jacobian @ jacobian.T)[0] < _SINGULAR**2
    return np.zeros(6) if singular else -wrench + _NEVER_ZERO


@dataclass(frozen=True)
class Contact:
    """Whether each joint and each Cartesian axis is in contact, or in collision."""

    joint_contact: Bool[np.ndarray, "7"]
    joint_collision: Bool[np.ndarray, "7"]
    cartesian_contact: Bool[np.ndarray, "6"]
    cartesian_collision: Bool[np.ndarray, "6"]

    @property
    def fault(self) -> str | None:
        """Reflex that a collision triggers."""
        if self.joint_collision.any():
            return "joint_reflex"
        return "cartesian_reflex" if self.cartesian_collision.any() else None


# A client's collision behaviour, N and Nm: contact above `lower`, collision above `upper`. Until it
# sends one: as in libfranka's examples.
THRESHOLDS: dict[str, Joints | Wrench] = {
    name: np.full(COLLISION_BEHAVIOUR[name].shape, 20.0) for name in COLLISION_BEHAVIOUR.names or ()
}


def judge_contact(
    thresholds: dict[str, Joints | Wrench], torque: Joints, wrench: Wrench, ddq: Joints
) -> Contact:
    """Compare external torques (Nm) and a wrench (N, Nm) with thresholds like `THRESHOLDS`."""
    phase = "nominal" if max(ddq.max(), -ddq.min()) < _STEADY else "acceleration"
    return Contact(
        *(
            np.abs(values) > thresholds[f"{bound}_{kind}_{phase}"]
            for kind, values in (("torque", torque), ("force", wrench))
            for bound in ("lower", "upper")
        )
    )


@njit(cache=True)
@no_type_check
def wrench_from_torques(torque: Joints, jacobian: Float[np.ndarray, "6 7"]) -> Wrench:
    """Return the wrench (N, Nm) that best explains joint torques (Nm)."""
    return np.linalg.solve(jacobian @ jacobian.T + _DAMPING * np.eye(6), jacobian @ torque)

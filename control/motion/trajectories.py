"""Timed moves for the arm itself: joint moves and straight lines inside every limit.

A path is a Chebyshev polynomial per joint over its length, walked with the minimum-jerk profile.
Speed, acceleration and jerk scale with the duration to the power of -1, -2 and -3, so the shortest
duration inside the limits follows from the path's peaks at once.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from touchgoal.control.errors import UserError
from touchgoal.control.motion.kinematics import (
    Joints,
    Kinematics,
    Matrix3,
    Vector3,
    rotation_matrix,
    rotation_vector,
)
from touchgoal.control.safety.action_filter import Safety
from touchgoal.control.safety.limits import JointLimits

_DEGREE = 16  # of a straight line's joints; 0.4 m are then straight within 0.1 mm
_STRAIGHT = 5e-4  # m off the line that are refused
_GRID = np.linspace(0, 1, 2001)  # where a path's peaks are looked for
# For peaks between the grid's points, and because a controller holds the speed over a millisecond
# against the taper at its end, up to 0.3 % lower.
_SLACK = 1.005


@dataclass(frozen=True)
class Trajectory:
    """Joint positions over time.

    Attributes:
        coefficients: of the Chebyshev polynomials over the path, whose ends are -1 and 1; rad.
        duration: s.
    """

    coefficients: Float[np.ndarray, "d n"]
    duration: float

    def at(self, t: Float[np.ndarray, "*k"] | float) -> Float[np.ndarray, "*k n"]:
        """Joint positions (rad) at times `t` (s); before the start and after the end it rests."""
        tau = np.atleast_1d(np.clip(t, 0, self.duration) / self.duration)
        s = _minimum_jerk(tau)[0].reshape(np.shape(t))
        return np.moveaxis(chebyshev.chebval(2 * s - 1, self.coefficients), 0, -1)

    def sample(self, hz: float) -> Float[np.ndarray, "k n"]:
        """Joint positions (rad) at a fixed rate, both ends included."""
        return self.at(np.arange(int(np.ceil(self.duration * hz)) + 1) / hz)


def joint_move(start: Joints, goal: Joints, limits: JointLimits) -> Trajectory:
    """Straight in joint space, all joints together, at rest at both ends.

    UserError if an end is outside the limits' range.
    """
    return _timed(np.stack([start + goal, goal - start]) / 2, limits)


def straight_line(
    kinematics: Kinematics,
    start: Joints,
    position: Vector3,
    rotation: Matrix3,
    limits: JointLimits,
) -> Trajectory:
    """The TCP straight from where `start` has it to a pose in the base frame, turning evenly.

    UserError if the line leaves the arm's reach or the limits' range, or bends at a singularity.
    """
    origin, turned = kinematics.forward(start)
    turn = rotation_vector(rotation @ turned.T)
    nodes = -np.cos(np.pi * np.arange(_DEGREE + 1) / _DEGREE)
    q = [np.asarray(start, dtype=np.float64)]
    for s in (nodes[1:] + 1) / 2:
        # Least motion, solved to rounding: noise of the solver would come back as jerk.
        solution = kinematics.solve_ik_near(
            origin + s * (position - origin),
            rotation_matrix(s * turn) @ turned,
            q[-1],
            posture=0.0,
            tolerance=1e-10,
        )
        if not solution.reached:
            raise UserError(
                f"the {kinematics.arm.name} cannot follow the line beyond {100 * s:.0f} % of it: "
                "move the end closer, or start from another posture"
            )
        q.append(solution.q)
    trajectory = _timed(chebyshev.chebfit(nodes, np.array(q), _DEGREE), limits)
    points = np.array(
        [kinematics.forward(p)[0] for p in trajectory.sample(100 / trajectory.duration)]
    )
    line = position - origin
    unit = line / max(float(np.linalg.norm(line)), 1e-9)
    away = points - origin
    off = np.linalg.norm(away - np.outer(away @ unit, unit), axis=1).max()
    if off > _STRAIGHT:
        raise UserError(
            f"the line passes a singular posture ({1e3 * off:.1f} mm off): start from another one"
        )
    return trajectory


def require_inside_workspace(trajectory: Trajectory, safety: Safety) -> None:
    """UserError if the flange or the fingers leave their boxes on the way (looked at 100 Hz)."""
    inside = safety.inside_workspace(trajectory.sample(100))
    if not inside.all():
        raise UserError(
            f"the move leaves the workspace box {np.argmin(inside) / 100:.1f} s after its start: "
            "go by way of another posture"
        )


def _minimum_jerk(tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Path share and its three derivatives: Flash and Hogan 1985."""
    return (
        tau**3 * (10 - 15 * tau + 6 * tau**2),
        30 * tau**2 * (1 - tau) ** 2,
        60 * tau * (1 - tau) * (1 - 2 * tau),
        60 * (1 - 6 * tau + 6 * tau**2),
    )


def _timed(coefficients: Float[np.ndarray, "d n"], limits: JointLimits) -> Trajectory:
    """The path walked as fast as the limits let it."""
    s, s1, s2, s3 = (d[:, None] for d in _minimum_jerk(_GRID))
    q, q1, q2, q3 = (
        2**k * chebyshev.chebval(2 * s[:, 0] - 1, chebyshev.chebder(coefficients, k)).T
        for k in range(4)
    )
    outside = ((q < limits.lower - 1e-9) | (q > limits.upper + 1e-9)).any(axis=0)
    if outside.any():
        i = int(np.argmax(outside))
        raise UserError(
            f"joint {i + 1} would leave {limits.lower[i]:.3f} to {limits.upper[i]:.3f} rad: "
            "choose another start or goal"
        )
    velocity = q1 * s1
    acceleration = q2 * s1**2 + q1 * s2
    jerk = q3 * s1**3 + 3 * q2 * s1 * s2 + q1 * s3
    low, high = limits.speed_range(q)
    ceiling = np.where(velocity > 0, high, -low)
    moving = np.abs(velocity) > 1e-12
    if (ceiling[moving] <= 0).any():
        raise UserError("the move ends where the arm allows no speed: keep away from joint limits")
    duration = max(
        (np.abs(velocity[moving]) / ceiling[moving]).max(initial=0.0),
        (np.abs(acceleration) / limits.acceleration).max() ** (1 / 2),
        (np.abs(jerk) / limits.jerk).max() ** (1 / 3),
        1e-3,  # of a move to where the arm already is
    )
    return Trajectory(coefficients, float(_SLACK * duration))

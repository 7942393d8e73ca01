"""Timed moves for the arm itself: joint moves and straight lines inside every limit.

A path is a Chebyshev polynomial per joint over its length. Ruckig walks it: the fastest profile from rest
to rest inside limits of speed, acceleration and jerk. Where a joint's speed limit shrinks near the end of
its range, slower cruises and longer braking are tried.
"""

from dataclasses import dataclass

import numpy as np
import ruckig
from jaxtyping import Float
from numpy.polynomial import chebyshev

from touchgoal.control.motion.arm_models import JointLimits, Joints
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.rotations import Matrix3, Vector3, rotation_matrix, rotation_vector
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.runtime.errors import UserError

_DEGREE = 16  # degree of a straight line's path; 0.4 m are then straight within 0.1 mm
_STRAIGHT = 5e-4  # m off the line that are refused
_SAMPLES = 1001  # times at which a move is compared with the limits
# Margin for peaks between these times, and for a taper limit that falls by up to 0.3 % within the
# millisecond for which a controller holds a speed.
_SLACK = 1.005
# Shares of full speed and of full braking that are tried where full ones would break a limit.
_SHARES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.3, 0.2)

Times = Float[np.ndarray, " k"]


@dataclass(frozen=True)
class Timing:
    """Share of a path walked over time, in pieces of constant jerk.

    `starts` (s) are the beginnings of the pieces, then the end; `rates` are the share and its first
    three derivatives there (1/s, 1/s^2, 1/s^3).
    """

    starts: Float[np.ndarray, " m"]
    rates: Float[np.ndarray, "4 m"]

    @classmethod
    def fastest(
        cls, speed: float, acceleration: float, deceleration: float, jerk: float
    ) -> "Timing":
        """Return Ruckig's fastest rest-to-rest profile within limits of the share's derivatives."""
        # s; in this unit jerk is 1, because the limits of very short paths are huge
        unit = jerk ** (-1 / 3)
        wanted, found = ruckig.InputParameter(1), ruckig.Trajectory(1)
        wanted.current_position, wanted.target_position = [0.0], [1.0]
        wanted.max_velocity, wanted.max_jerk = [speed * unit], [1.0]
        wanted.max_acceleration = [acceleration * unit**2]
        wanted.min_acceleration = [-deceleration * unit**2]
        result = ruckig.Ruckig(1).calculate(wanted, found)
        assert result == ruckig.Result.Working, result
        profile = found.profiles[0][0]
        rates = np.array([profile.p, profile.v, profile.a, [*profile.j, 0.0]])
        return cls(np.append(0.0, np.cumsum(profile.t)), rates).slowed(unit)

    @property
    def duration(self) -> float:
        """Duration from rest to rest, s."""
        return float(self.starts[-1])

    def derivatives(self, t: Times) -> tuple[Times, Times, Times, Times]:
        """Return the share of the path and its first three derivatives at times `t` (s)."""
        piece = np.clip(np.searchsorted(self.starts, t, "right") - 1, 0, self.starts.size - 1)
        s, s1, s2, s3 = self.rates[:, piece]
        moves = (t >= 0) & (t < self.duration)
        dt = np.where(moves, t - self.starts[piece], 0.0)
        share = s + dt * (s1 + dt * (s2 / 2 + dt * s3 / 6))
        rates = (s1 + dt * (s2 + dt * s3 / 2), s2 + dt * s3, s3)
        speed, acceleration, jerk = (np.where(moves, rate, 0.0) for rate in rates)
        return np.where(t < self.duration, share, 1.0), speed, acceleration, jerk

    def slowed(self, factor: float) -> "Timing":
        """Return the same profile, `factor` times as long."""
        return Timing(factor * self.starts, self.rates / factor ** np.arange(4)[:, None])


@dataclass(frozen=True)
class Trajectory:
    """Joint positions over time: `timing` of the walk along a path of Chebyshev polynomials.

    Their `coefficients` are in rad; the path's ends are -1 and 1.
    """

    coefficients: Float[np.ndarray, "d n"]
    timing: Timing

    @property
    def duration(self) -> float:
        """Duration from rest to rest, s."""
        return self.timing.duration

    def at(self, t: Float[np.ndarray, "*k"] | float) -> Float[np.ndarray, "*k n"]:
        """Return the joint positions (rad) at times `t` (s); at rest before the start and after the end."""
        times = np.asarray(t, dtype=np.float64)
        s = self.timing.derivatives(times.ravel())[0].reshape(times.shape)
        return np.moveaxis(chebyshev.chebval(2 * s - 1, self.coefficients), 0, -1)

    def sample(self, hz: float) -> Float[np.ndarray, "k n"]:
        """Return the joint positions (rad) at a fixed rate, both ends included."""
        return self.at(np.arange(int(np.ceil(self.duration * hz)) + 1) / hz)


def joint_move(start: Joints, goal: Joints, limits: JointLimits) -> Trajectory:
    """Return all joints' straight move, rest to rest; UserError if an end is out of range."""
    return _timed(np.stack([start + goal, goal - start]) / 2, limits)


def straight_line(
    kinematics: Kinematics, start: Joints, position: Vector3, rotation: Matrix3, limits: JointLimits
) -> Trajectory:
    """Return the TCP's straight line from `start` to a pose in the base frame, turning evenly.

    UserError if the line leaves the arm's reach or the limits' range, or bends at a singularity.
    """
    origin, turned = kinematics.forward(start)
    turn = rotation_vector(rotation @ turned.T)
    nodes = -np.cos(np.pi * np.arange(_DEGREE + 1) / _DEGREE)
    q = [np.asarray(start, dtype=np.float64)]
    for s in (nodes[1:] + 1) / 2:
        solution = kinematics.solve_ik_near(  # least motion, exactly: noise would show as jerk
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
    points = kinematics.forward_many(trajectory.sample(100 / trajectory.duration))[0]
    line = position - origin
    unit = line / max(float(np.linalg.norm(line)), 1e-9)
    away = points - origin
    off = np.linalg.norm(away - np.outer(away @ unit, unit), axis=1).max()
    if off > _STRAIGHT:
        raise UserError(
            f"the line passes a singular posture ({1e3 * off:.1f} mm off): start from another one"
        )
    return trajectory


def require_inside_workspace(trajectory: Trajectory, safety: ActionFilter) -> None:
    """UserError if flange or fingers leave their boxes on the way (checked at 100 Hz)."""
    inside = safety.inside_workspace(trajectory.sample(100))
    if not inside.all():
        raise UserError(
            f"the move leaves the workspace box {np.argmin(inside) / 100:.1f} s after its start: "
            "go by way of another posture"
        )


def _timed(coefficients: Float[np.ndarray, "d n"], limits: JointLimits) -> Trajectory:
    """Return the path walked as fast as the limits let it."""
    q, slope = (_path(coefficients, np.linspace(0, 1, _SAMPLES), k) for k in (0, 1))
    _require_range(q, limits)
    steepest = np.abs(slope).max(axis=0)
    if not steepest.any():
        return Trajectory(coefficients, Timing.fastest(1e3, 1e6, 1e6, 1e9))  # it is there already
    full = [
        float((limit / np.maximum(steepest, 1e-12)).min())
        for limit in (limits.velocity, limits.acceleration, limits.jerk)
    ]
    best = None
    for cruise in _SHARES:
        for braking in _SHARES:
            timing = Timing.fastest(cruise * full[0], full[1], braking * full[1], full[2])
            if best is not None and timing.duration >= best.duration:
                break  # slower braking takes longer still
            timing = timing.slowed(_excess(coefficients, timing, limits))
            if best is None or timing.duration < best.duration:
                best = timing
    assert best is not None
    return Trajectory(coefficients, best.slowed(_SLACK))


def _path(
    coefficients: Float[np.ndarray, "d n"], s: Float[np.ndarray, " k"], order: int
) -> Float[np.ndarray, "k n"]:
    """Return the joint positions at shares `s` of the path, or their derivative by the share."""
    derived = chebyshev.chebder(coefficients, order)
    return 2**order * chebyshev.chebval(2 * s - 1, derived).T


def _require_range(q: Float[np.ndarray, "k n"], limits: JointLimits) -> None:
    outside = ((q < limits.lower - 1e-9) | (q > limits.upper + 1e-9)).any(axis=0)
    if outside.any():
        i = int(np.argmax(outside))
        raise UserError(
            f"joint {i + 1} would leave {limits.lower[i]:.3f} to {limits.upper[i]:.3f} rad: "
            "choose another start or goal"
        )


def _excess(coefficients: Float[np.ndarray, "d n"], timing: Timing, limits: JointLimits) -> float:
    """Return how many times as long the path must take to be inside every limit; at least 1.

    Speed, acceleration and jerk fall with the duration to the power of -1, -2 and -3.
    """
    corners = timing.starts, timing.starts - 1e-9  # where the jerk changes, and before
    t = np.concatenate([np.linspace(0, timing.duration, _SAMPLES), *corners])
    s, *rates = timing.derivatives(t)
    s1, s2, s3 = (rate[:, None] for rate in rates)
    q, q1, q2, q3 = (_path(coefficients, s, order) for order in range(4))
    velocity = q1 * s1
    acceleration = q2 * s1**2 + q1 * s2
    jerk = q3 * s1**3 + 3 * q2 * s1 * s2 + q1 * s3
    low, high = limits.speed_range(q)
    ceiling = np.where(velocity > 0, high, -low)
    moving = np.abs(velocity) > 1e-9
    if (ceiling[moving] <= 0).any():
        raise UserError("the move ends where the arm allows no speed: keep away from joint limits")
    return max(
        1.0,
        (np.abs(velocity[moving]) / ceiling[moving]).max(initial=0.0),
        (np.abs(acceleration) / limits.acceleration).max() ** (1 / 2),
        (np.abs(jerk) / limits.jerk).max() ** (1 / 3),
    )

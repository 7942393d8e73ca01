"""How a UR moves between commands: moves with trapezoidal speed, servo, speed, stop."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from ruckig import InputParameter, Ruckig, Trajectory

from touchgoal.control.motion.rotations import rotation_matrix, rotation_vector
from touchgoal.control.safety.braking import braked_velocity
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell

_SERVO_ACCELERATION = 40.0  # rad/s^2, the most that ur-rtde lets a client ask for
_STILL = 1e-3  # rad/s
_DAMPING = 1e-6  # m^2: keeps joint speeds finite near singular poses

Joints = Float[np.ndarray, "6"]
Target = tuple[Joints, Joints]  # rad, rad/s


class _Trapezoid:
    """Distance covered from rest to rest, at most at a speed and an acceleration."""

    def __init__(self, length: float, speed: float, acceleration: float) -> None:
        self._length, self._time = max(length, 1e-9), 0.0
        limits = InputParameter(1)
        limits.target_position = [self._length]
        limits.max_velocity, limits.max_acceleration = [speed], [acceleration]
        self._trajectory = Trajectory(1)
        Ruckig(1).calculate(limits, self._trajectory)

    def advance(self, dt: float) -> tuple[float, float]:
        """Return the share of the way after another `dt` s, and its rate (1/s)."""
        self._time += dt
        (way,), (rate,), _ = self._trajectory.at_time(self._time)
        return way / self._length, rate / self._length

    @property
    def done(self) -> bool:
        return self._time >= self._trajectory.duration


class JointMove:
    """`movej`: linear in joint space; speed (rad/s) and acceleration (rad/s^2) of the leading axis.

    A moving arm is brought to rest first.
    """

    def __init__(self, goal: Joints, speed: float, acceleration: float) -> None:
        self._goal, self._speed, self._acceleration = goal, speed, acceleration
        self._profile: _Trapezoid | None = None

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """Return the next target."""
        if self._profile is None:
            if np.abs(dq).max() > _STILL:
                dq = braked_velocity(dq, np.full(6, self._acceleration), DT)
                return q + DT * dq, dq
            self._start = q
            length = float(np.abs(self._goal - q).max())
            self._profile = _Trapezoid(length, self._speed, self._acceleration)
        share, rate = self._profile.advance(speed_fraction * DT)
        way = self._goal - self._start
        return self._start + share * way, speed_fraction * rate * way * (not self.done)

    @property
    def done(self) -> bool:
        """Whether the goal is reached."""
        return self._profile is not None and self._profile.done


class LineMove:
    """`movel`: the TCP on a straight line from rest; m/s and m/s^2, or rad if it mostly turns."""

    def __init__(
        self,
        cell: SimulatedCell,
        pose: Float[np.ndarray, "6"],
        speed: float,
        acceleration: float,
    ) -> None:
        """`pose`: m and rotation vector (rad), base frame."""
        self._cell = cell
        self._from, self._R, _ = cell.kinematics(cell.q_d)
        self._way = pose[:3] - self._from
        self._turn = rotation_vector(rotation_matrix(pose[3:]) @ self._R.T)
        length = max(float(np.linalg.norm(self._way)), float(np.linalg.norm(self._turn)))
        self._profile = _Trapezoid(length, speed, acceleration)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """Return the next target; differential inverse kinematics that corrects its own drift."""
        share, _ = self._profile.advance(speed_fraction * DT)
        position, R, J = self._cell.kinematics(q)
        target = rotation_matrix(share * self._turn) @ self._R
        error = np.concatenate(
            [self._from + share * self._way - position, rotation_vector(target @ R.T)]
        )
        dq = J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(6), error / DT)
        return q + DT * dq, dq * (not self.done)

    @property
    def done(self) -> bool:
        """Whether the goal is reached."""
        return self._profile.done


@dataclass
class Servo:
    """`servoj`: follow a goal (rad) that changes all the time, about `lookahead` s behind it."""

    speed: Joints
    goal: Joints
    lookahead: float
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """Return the next target."""
        desired = np.clip((self.goal - q) / self.lookahead, -self.speed, self.speed)
        change = _SERVO_ACCELERATION * DT
        dq = dq + np.clip(desired - dq, -change, change)
        return q + DT * dq, dq


@dataclass
class Speed:
    """`speedj`: constant joint speed (rad/s)."""

    goal: Joints
    acceleration: float
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """Return the next target."""
        missing = self.goal - dq
        most = np.abs(missing).max()
        dq = dq + missing * min(1.0, self.acceleration * DT / max(most, 1e-12))
        return q + DT * dq, dq


@dataclass
class Stop:
    """`stopj`: slow down (rad/s^2, leading axis) along the way, then rest."""

    deceleration: float
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """Return the next target."""
        fastest = float(np.abs(dq).max())
        left = max(0.0, fastest - self.deceleration * DT)
        dq = dq * (left / fastest if fastest > 0 else 0.0)
        self.done = left == 0.0
        return q + DT * dq, dq


Activity = JointMove | LineMove | Servo | Speed | Stop

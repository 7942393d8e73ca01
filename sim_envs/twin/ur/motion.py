"""How a UR moves between commands: moves with trapezoidal speed, servo, speed, stop."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.motion.rotations import rotation_matrix, rotation_vector
from touchgoal.control.safety.braking import braked_velocity
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell

_SERVO_ACCELERATION = 40.0  # rad/s^2, the most that ur-rtde lets a client ask for
_STILL = 1e-3  # rad/s
# Our choices: the maker's controllers are unpublished.
_FORCE_GAIN, _FORCE_SPEED = 2e-3, 0.1  # m/s for each N missing, and m/s at most; likewise rad, Nm
_FREEDRIVE_GAIN, _FREEDRIVE_SPEED = 0.05, 0.5  # rad/s for each Nm, and rad/s at most

Joints = Float[np.ndarray, "6"]
Target = tuple[Joints, Joints]  # rad, rad/s


@runtime_checkable
class Activity(Protocol):
    """Something the arm is doing."""

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next millisecond's target after the last one; `speed_fraction`: the speed slider."""
        ...

    @property
    def done(self) -> bool:
        """Whether it has come to its end."""
        ...


@dataclass
class _Trapezoid:
    """Distance covered at constant acceleration, speed, deceleration, from rest to rest."""

    length: float
    speed: float
    acceleration: float
    time: float = 0.0

    def __post_init__(self) -> None:
        # Too short a way for the full speed: a triangle.
        self.speed = min(self.speed, np.sqrt(self.length * self.acceleration))
        self.speed = max(self.speed, 1e-9)
        self.duration = self.length / self.speed + self.speed / self.acceleration

    def advance(self, dt: float) -> tuple[float, float]:
        """Share of the way after another `dt` s, and its rate (1/s)."""
        self.time = min(self.time + dt, self.duration)
        ramp, left = self.speed / self.acceleration, self.duration - self.time
        if self.time < ramp:
            way, rate = self.acceleration * self.time**2 / 2, self.acceleration * self.time
        elif left > ramp:
            way, rate = self.speed * (self.time - ramp / 2), self.speed
        else:
            way, rate = self.length - self.acceleration * left**2 / 2, self.acceleration * left
        return way / max(self.length, 1e-12), rate / max(self.length, 1e-12)


class JointMove:
    """`movej`: linear in joint space; speed (rad/s) and acceleration (rad/s^2) of the leading axis.

    A moving arm is brought to rest first.
    """

    def __init__(self, goal: Joints, speed: float, acceleration: float) -> None:
        self._goal, self._speed, self._acceleration = goal, speed, acceleration
        self._profile: _Trapezoid | None = None

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next target."""
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
        return self._profile is not None and bool(self._profile.time >= self._profile.duration)


class LineMove:
    """`movel`: the TCP on a straight line from rest; m/s and m/s^2, or rad if it mostly turns."""

    def __init__(
        self,
        cell: SimulatedCell,
        offset: Float[np.ndarray, "3"],
        position: Float[np.ndarray, "3"],
        rotation: Float[np.ndarray, "3 3"],
        speed: float,
        acceleration: float,
    ) -> None:
        self._cell, self._offset = cell, offset
        self._from, self._R, _ = cell.kinematics(cell.q_d, offset)
        self._way, self._turn = position - self._from, rotation_vector(rotation @ self._R.T)
        length = max(float(np.linalg.norm(self._way)), float(np.linalg.norm(self._turn)))
        self._profile = _Trapezoid(length, speed, acceleration)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next target, by differential inverse kinematics that corrects its own drift."""
        share, rate = self._profile.advance(speed_fraction * DT)
        position, R, jacobian = self._cell.kinematics(q, self._offset)
        wanted = rotation_matrix(share * self._turn) @ self._R
        error = np.concatenate(
            [self._from + share * self._way - position, rotation_vector(wanted @ R.T)]
        )
        J = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + 1e-6 * np.eye(6))
        dq = J @ (error / DT)
        return q + DT * dq, dq * (not self.done)

    @property
    def done(self) -> bool:
        """Whether the goal is reached."""
        return bool(self._profile.time >= self._profile.duration)


@dataclass
class Servo:
    """`servoj`: follow a goal (rad) that changes all the time, about `lookahead` s behind it."""

    speed: Joints
    goal: Joints
    lookahead: float
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next target."""
        wanted = np.clip((self.goal - q) / self.lookahead, -self.speed, self.speed)
        change = _SERVO_ACCELERATION * DT
        dq = dq + np.clip(wanted - dq, -change, change)
        return q + DT * dq, dq


@dataclass
class Speed:
    """`speedj` or `speedl`: go on at a joint speed (rad/s), or a TCP twist (m/s, rad/s)."""

    goal: Joints
    acceleration: float
    cell: SimulatedCell | None = None
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next target."""
        goal = self.goal
        if self.cell is not None:
            _, _, J = self.cell.kinematics(q, np.zeros(3))
            goal = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), self.goal)
        missing = goal - dq
        most = np.abs(missing).max()
        dq = dq + missing * min(1.0, self.acceleration * DT / max(most, 1e-12))
        return q + DT * dq, dq


@dataclass
class Stop:
    """`stopj`: slow down (rad/s^2, leading axis) along the way, then rest."""

    deceleration: float
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next target."""
        fastest = float(np.abs(dq).max())
        left = max(0.0, fastest - self.deceleration * DT)
        dq = dq * (left / fastest if fastest > 0 else 0.0)
        self.done = left == 0.0
        return q + DT * dq, dq


@dataclass
class Force:
    """`force_mode`: along free axes of the base the arm gives way until it pushes as hard as asked.

    Attributes:
        free: which of x, y, z, rx, ry, rz are.
        wanted: N and Nm that the robot is to apply to its environment.
        limits: m/s and rad/s of the free axes.
        wrench: reads what the environment does to the robot.
    """

    cell: SimulatedCell
    free: Bool[np.ndarray, "6"]
    wanted: Float[np.ndarray, "6"]
    limits: Float[np.ndarray, "6"]
    wrench: Callable[[], Float[np.ndarray, "6"]]
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next target."""
        missing = self.wanted + self.wrench()
        most = np.minimum(self.limits, _FORCE_SPEED)
        twist = self.free * np.clip(_FORCE_GAIN * missing, -most, most)
        _, _, J = self.cell.kinematics(q, np.zeros(3))
        goal = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), twist)
        dq = dq + np.clip(goal - dq, -_SERVO_ACCELERATION * DT, _SERVO_ACCELERATION * DT)
        return q + DT * dq, dq


@dataclass
class Freedrive:
    """`freedrive_mode`: every joint gives way to what pushes it."""

    cell: SimulatedCell
    done: bool = field(default=False, init=False)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        """The next target."""
        goal = np.clip(_FREEDRIVE_GAIN * self.cell.tau_ext, -_FREEDRIVE_SPEED, _FREEDRIVE_SPEED)
        dq = dq + np.clip(goal - dq, -_SERVO_ACCELERATION * DT, _SERVO_ACCELERATION * DT)
        return q + DT * dq, dq

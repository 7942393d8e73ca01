"""The safety layer: every commanded joint change is clamped, every fault stops the arm for good.

Pure: a state goes in, a new one comes out. It keeps one invariant: from where the command is,
braking stops inside every limit. A tick follows the policy's command only as far as this holds for
the next command, too; otherwise it brakes along the path already checked.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float

from touchgoal.control.motion.arm_models import Joints
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.safety.limits import RobotLimits, braked_velocity, max_stoppable_speed
from touchgoal.runtime.errors import UserError

Allows = Callable[[Joints, Float[np.ndarray, "c n"]], Bool[np.ndarray, " c"]]


class Mode(StrEnum):
    """Mode of the arm: it follows the policy, brakes and waits, or is stopped until a restart."""

    MOVE = "move"
    HOLD = "hold"
    STOP = "stop"


class Limit(StrEnum):
    """A limit that changed a command."""

    NOT_A_NUMBER = "not a number"
    STEP = "step"
    MARGIN = "joint margin"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    WORKSPACE = "workspace"
    TIP_SPEED = "fingertip speed"
    STALE_OBSERVATION = "observation age"
    STALE_ACTION = "action age"
    STALE_STATE = "robot state age"
    STALE_GRIPPER = "gripper age"
    FORCE = "external force"
    TORQUE = "external torque"
    LOAD = "load on the table"
    INDENTATION = "gel indentation"
    TRACKING = "distance of joints from command"


@dataclass(frozen=True)
class Fault:
    """Why the arm was stopped: the measured value and its ceiling, in SI units."""

    limit: Limit
    value: float
    ceiling: float

    def __str__(self) -> str:
        if self.limit == Limit.NOT_A_NUMBER:
            return f"the policy's action was not a number for {self.value:.2f} s"
        if np.isnan(self.value):
            return f"{self.limit} is unknown"
        return f"{self.limit} {self.value:.3g} above {self.ceiling:.3g}"


@dataclass(frozen=True)
class Deadline:
    """Ages (s) beyond which the arm holds, then stops."""

    hold: float
    stop: float


@dataclass(frozen=True)
class Watchdogs:
    """Deadlines for images, the policy's action, the arm's and the gripper's state.

    Our choices. Hold: two ticks at 20 Hz for images and actions. Stop: below the 1 s after which
    libfranka drops a silent connection (measured: NetworkException after 1.02 to 1.06 s). A Franka
    Hand's state comes every 20 to 50 ms.
    """

    observation: Deadline = Deadline(0.1, 0.5)
    action: Deadline = Deadline(0.1, 0.5)
    state: Deadline = Deadline(0.05, 0.25)
    gripper: Deadline = Deadline(0.3, 1.0)


@dataclass(frozen=True)
class Measurements:
    """Measurements of one tick."""

    q: Joints  # measured joint positions, rad
    force: Float[np.ndarray, "3"]  # external force on the TCP, N
    torque: Joints  # external torque in each joint, Nm
    indentation: Float[np.ndarray, "2"]  # depth in each fingertip's gel, m
    # Age of the oldest of each, s.
    observation_age: float
    action_age: float
    state_age: float
    gripper_age: float
    load: float = 0.0  # change of the load cell's force since the start, N; 0 without one


@dataclass(frozen=True)
class SafetyState:
    """Safe command of a tick, from which the next one continues."""

    # Commanded joint positions, rad, and their velocity, rad/s.
    q: Joints
    velocity: Joints
    mode: Mode = Mode.HOLD
    active_limits: tuple[Limit, ...] = ()  # limits that changed the command this tick
    fault: Fault | None = None  # the first fault; it stays
    bad_actions: int = 0  # ticks since the last finite action


# Shares of the way from braking to the wanted command, tried in turn if that is not allowed.
_SHARES = np.array([0.8, 0.6, 0.4, 0.2])
_ROUNDING = 1e-12  # rad/s; a smaller change is no clamp


class ActionFilter:
    """The limits of one robot at one control rate (Hz)."""

    def __init__(self, limits: RobotLimits, hz: float, watchdogs: Watchdogs | None = None) -> None:
        self.limits, self.joints = limits, limits.policy
        self.dt = 1 / hz  # s, of a control tick
        self.watchdogs = watchdogs or Watchdogs()
        edges = np.array(((0.0, 0.0, 0.0), *limits.tool.finger_corners))
        self._flange = limits.flange.shrunk(limits.reserve)
        self.fingertips = limits.fingertips.shrunk(limits.reserve)  # for their corners, base frame
        self._points = Kinematics(limits.arm, 0.0).points_on_links(edges)
        unit = self.joints.acceleration * self.dt
        self._braking_ticks = int(np.ceil(self.joints.velocity / unit).max()) + 1

    def start(self, q: Joints) -> SafetyState:
        """Return the state of an arm at rest; UserError if it rests outside a policy's limits."""
        outside = np.flatnonzero(~((q >= self.joints.lower) & (q <= self.joints.upper)))
        if outside.size:
            i = int(outside[0])
            raise UserError(
                f"joint {i + 1} is at {q[i]:.3f} rad, outside {self.joints.lower[i]:.3f} to "
                f"{self.joints.upper[i]:.3f}: move the arm there by hand, then start again"
            )
        if not self.inside_workspace(q[None])[0]:
            raise UserError(
                "the flange or the fingers are outside the workspace box: move the arm into it by "
                "hand, or widen the box in the cell file's [safety]"
            )
        return SafetyState(np.array(q), np.zeros(q.size))

    def filter_action(
        self, state: SafetyState, action: Joints, reading: Measurements
    ) -> SafetyState:
        """Return the safe command for a wanted joint change (rad), relative to the last command.

        The arm holds while something is stale or the action is not finite; it stops at the first
        fault, and only a new `start` ends that. In STOP the driver also stops by its own means.
        """
        finite = action.shape == state.q.shape and bool(np.isfinite(action).all())
        state = replace(state, bad_actions=0 if finite else state.bad_actions + 1)
        fault = state.fault or self._fault(state, reading)
        if fault:
            return self._brake(state, Mode.STOP, (fault.limit,), fault)
        stale = self._stale(reading) + (() if finite else (Limit.NOT_A_NUMBER,))
        if stale:
            return self._brake(state, Mode.HOLD, stale, None)
        return self._move(state, action)

    def filter_width(self, state: SafetyState, target: float, last: float) -> float:
        """Return the gripper width (m) to command in the tick that led to `state`.

        It is the target inside the stroke. While the arm holds or is stopped, and for a target that
        is not finite, it is the last command: no object is dropped or squeezed then.
        """
        if state.mode is not Mode.MOVE or not np.isfinite(target):
            return last
        return float(np.clip(target, *self.limits.tool.stroke))

    def inside_workspace(self, q: Float[np.ndarray, "k n"]) -> Bool[np.ndarray, " k"]:
        """Return whether flange and finger edges lie in their boxes, less the reserve."""
        points = self.monitored_points(q)
        flange = self._flange.contains(points[:, 0])
        return flange & self.fingertips.contains(points[:, 1:]).all(axis=1)

    def monitored_points(self, q: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k p 3"]:
        """Return the flange and the fingertips' corners (m, base frame) for each of k postures."""
        return self._points(q.T).full().T.reshape(len(q), -1, 3)

    def tip_speed(self, q: Joints, velocity: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " k"]:
        """Return the speed (m/s) of the fastest monitored point for each of k joint velocities."""
        points = self.monitored_points(np.vstack([q, q + velocity * self.dt]))
        return np.linalg.norm(points[1:] - points[0], axis=-1).max(axis=1) / self.dt

    def _ages(self, reading: Measurements) -> list[tuple[Limit, float, Deadline]]:
        w = self.watchdogs
        return [
            (Limit.STALE_OBSERVATION, reading.observation_age, w.observation),
            (Limit.STALE_ACTION, reading.action_age, w.action),
            (Limit.STALE_STATE, reading.state_age, w.state),
            (Limit.STALE_GRIPPER, reading.gripper_age, w.gripper),
        ]

    def _stale(self, reading: Measurements) -> tuple[Limit, ...]:
        return tuple(name for name, age, dead in self._ages(reading) if not age <= dead.hold)

    def _fault(self, state: SafetyState, reading: Measurements) -> Fault | None:
        """Return the first ceiling exceeded; NaN exceeds every ceiling."""
        limits = self.limits
        checks = [(name, age, dead.stop) for name, age, dead in self._ages(reading)]
        checks += [
            (Limit.FORCE, np.linalg.norm(reading.force), limits.force),
            (Limit.TORQUE, np.abs(reading.torque).max(), limits.torque),
            (Limit.LOAD, abs(reading.load), limits.force),
            (Limit.INDENTATION, np.abs(reading.indentation).max(), limits.indentation),
            (Limit.TRACKING, np.abs(reading.q - state.q).max(), limits.tracking),
            (Limit.NOT_A_NUMBER, state.bad_actions * self.dt, self.watchdogs.action.stop),
        ]
        for name, value, ceiling in checks:
            if not value <= ceiling:
                return Fault(name, float(value), ceiling)
        return None

    def _brake(
        self, state: SafetyState, mode: Mode, active_limits: tuple[Limit, ...], fault: Fault | None
    ) -> SafetyState:
        velocity = braked_velocity(state.velocity, self.joints.acceleration, self.dt)
        q = state.q + velocity * self.dt
        return replace(
            state, q=q, velocity=velocity, mode=mode, active_limits=active_limits, fault=fault
        )

    def _move(self, state: SafetyState, action: Joints) -> SafetyState:
        j, dt, active_limits = self.joints, self.dt, []

        def clamp(velocity: Joints, low: Joints, high: Joints, name: Limit) -> Joints:
            clamped = np.clip(velocity, low, high)
            if (np.abs(clamped - velocity) > _ROUNDING).any():
                active_limits.append(name)
            return clamped

        step = np.full(action.size, self.limits.max_step)
        velocity = clamp(action, -step, step, Limit.STEP) / dt  # clipped first: floats may overflow
        velocity = clamp(velocity, -j.velocity, j.velocity, Limit.VELOCITY)
        down = -max_stoppable_speed(state.q - j.lower, j.acceleration, dt)
        up = max_stoppable_speed(j.upper - state.q, j.acceleration, dt)
        velocity = clamp(velocity, down, up, Limit.MARGIN)
        reach = j.acceleration * dt
        velocity = clamp(
            velocity, state.velocity - reach, state.velocity + reach, Limit.ACCELERATION
        )
        slower = self._allowed_velocity(state, velocity, self._slow_enough)
        if slower is not velocity:
            active_limits.append(Limit.TIP_SPEED)
        safe = self._allowed_velocity(state, slower, self._stops_inside)
        if safe is not slower:
            active_limits.append(Limit.WORKSPACE)
        q = state.q + safe * dt
        return replace(
            state, q=q, velocity=safe, mode=Mode.MOVE, active_limits=tuple(active_limits)
        )

    def _allowed_velocity(self, state: SafetyState, wanted: Joints, allows: Allows) -> Joints:
        """Return the allowed velocity nearest to the wanted one, on the way to it from braking."""
        if allows(state.q, wanted[None])[0]:
            return wanted
        rest = braked_velocity(state.velocity, self.joints.acceleration, self.dt)
        tries = rest + _SHARES[:, None] * (wanted - rest)
        good = np.flatnonzero(allows(state.q, tries))
        return tries[good[0]] if good.size else rest

    def _slow_enough(self, q: Joints, velocity: Float[np.ndarray, "c n"]) -> Bool[np.ndarray, " c"]:
        return self.tip_speed(q, velocity) <= self.limits.tip_speed

    def _stops_inside(
        self, q: Joints, velocity: Float[np.ndarray, "c n"]
    ) -> Bool[np.ndarray, " c"]:
        """Return, for each candidate velocity, whether this tick and the braking after it stay inside."""
        # Braking alone is the path checked a tick ago, computed by the same operations in the same
        # order, hence inside to the last bit. Postures between two ticks are not checked: the joints
        # move by less than 0.03 rad, and a point leaves the chord by less than 0.1 mm.
        path = [q + velocity * self.dt]
        for _ in range(self._braking_ticks):
            velocity = braked_velocity(velocity, self.joints.acceleration, self.dt)
            path.append(path[-1] + velocity * self.dt)
        inside = self.inside_workspace(np.concatenate(path))
        return np.all(inside.reshape(len(path), -1), axis=0)

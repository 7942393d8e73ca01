"""The control program that ur-rtde uploads, executed command by command.

The URScript itself is not interpreted. Arguments of a command lie in the input registers, answers
in the output registers; output register 0 is 1 (ready for a command) or 2 (done). Simulated: moveJ,
moveL, servoJ, their stops, the watchdog, zeroFtSensor and protective stops. Payload and
gains are accepted without effect. All else is refused.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from ruckig import InputParameter, Ruckig, Trajectory

from touchgoal.control.motion.rotations import rotation_matrix, rotation_vector
from touchgoal.control.safety.limits import UR5E, braked_velocity
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell

_READY, _DONE = 1, 2
# Numbers of ur-rtde's commands. Streamed ones are acknowledged at once.
_STREAMED = {6, 9, 10, 11, 12, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71}
_WITHOUT_EFFECT = {0, 13, 14, 17, 20, 21, 48, 59, 65, 99}  # payload, gains, a kick of the watchdog
_UNANSWERED = {25, 66}  # toolContact, directTorque: clients do not read an answer
_REFUSAL_CYCLES = 250  # 0.5 s at most; a client that waits for an answer gives up much earlier
_STOP_SCRIPT = 255
_PACE = 1e-3, 40.0  # least and most that ur-rtde accepts: speed (rad/s, m/s), acceleration (per s)

_SERVO_ACCELERATION = 40.0  # rad/s^2, the most that ur-rtde lets a client ask for
_STILL = 1e-3  # rad/s
_DAMPING = 1e-6  # m^2: keeps joint speeds finite near singular poses

Joints = Float[np.ndarray, "6"]
Pose = Float[np.ndarray, "6"]  # m, rotation vector (rad)
Target = tuple[Joints, Joints]  # rad, rad/s


# How a UR moves between commands. Each motion's `step` returns the target a millisecond later.


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


class _JointMove:
    """`movej`: linear in joint space; speed (rad/s) and acceleration (rad/s^2) of the leading axis.

    A moving arm is brought to rest first.
    """

    def __init__(self, goal: Joints, speed: float, acceleration: float) -> None:
        self._goal, self._speed, self._acceleration = goal, speed, acceleration
        self._profile: _Trapezoid | None = None

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
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
        return self._profile is not None and self._profile.done


class _LineMove:
    """`movel`: the TCP on a straight line from rest; m/s and m/s^2, or rad if it mostly turns."""

    def __init__(self, cell: SimulatedCell, pose: Pose, speed: float, acceleration: float) -> None:
        self._cell = cell
        self._from, self._R, _ = cell.kinematics(cell.q_d)
        self._way = pose[:3] - self._from
        self._turn = rotation_vector(rotation_matrix(pose[3:]) @ self._R.T)
        length = max(float(np.linalg.norm(self._way)), float(np.linalg.norm(self._turn)))
        self._profile = _Trapezoid(length, speed, acceleration)

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        # Differential inverse kinematics that corrects its own drift.
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
        return self._profile.done


@dataclass
class _Servo:
    """`servoj`: follow a goal (rad) that keeps changing, about `lookahead` s behind it."""

    speed: Joints
    goal: Joints
    lookahead: float
    done = False

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        desired = np.clip((self.goal - q) / self.lookahead, -self.speed, self.speed)
        change = _SERVO_ACCELERATION * DT
        dq = dq + np.clip(desired - dq, -change, change)
        return q + DT * dq, dq


@dataclass
class _Stop:
    """`stopj`: slow down (rad/s^2, leading axis) along the way, then rest."""

    deceleration: float
    done = False

    def step(self, q: Joints, dq: Joints, speed_fraction: float) -> Target:
        fastest = float(np.abs(dq).max())
        left = max(0.0, fastest - self.deceleration * DT)
        dq = dq * (left / fastest if fastest > 0 else 0.0)
        self.done = left == 0.0
        return q + DT * dq, dq


class UrProgram:
    """One run of the control program."""

    def __init__(
        self,
        cell: SimulatedCell,
        inputs: dict[str, float],
        protective_stop: Callable[[], None],
        zero_force: Callable[[], None],
    ) -> None:
        """`protective_stop` stops the arm; `zero_force` zeroes the force sensor."""
        # inputs: the client's input registers by name
        self.cell, self.inputs = cell, inputs
        self._protective_stop, self._zero_force = protective_stop, zero_force
        self.activity: _JointMove | _LineMove | _Servo | _Stop | None = None  # in progress
        # ints: integer output registers; running: false once the program has ended
        self.ints, self.running = [_READY] + [0] * 47, True
        self.doubles = [0.0] * 48  # output registers
        self._refused = self._cycles_refused = 0
        self.watchdog = np.inf  # s without a command after which the program ends
        self._executing = self._waiting = self._asynchronous = False
        self._started = 0

    def cycle(self) -> None:
        """Look at the command register once: every 2 ms, and when a package arrives."""
        finished = self.activity is None or self.activity.done
        if self._waiting:
            if not finished:
                return
            self._waiting, self.ints[0] = False, _DONE
        if self._asynchronous and finished:
            self._asynchronous = False
            self.ints[2] = self._started << 24
        command = self._int(0)
        if command == self._refused and command:
            self._cycles_refused += 1
            return
        self._refused = 0
        if command in _STREAMED:
            self._execute(command)
            self.ints[0] = 0 if self._refused else _READY
        elif command == 0:
            self._executing, self.ints[0] = False, _READY
        elif not self._executing:
            self._executing, self.ints[0] = True, 0
            self._execute(command)
            if not self._waiting and self.running and not self._refused:
                self.ints[0] = _DONE

    @property
    def reported_running(self) -> bool:
        """Running state for clients: false while a command is refused."""
        refusing = self._refused and self._cycles_refused < _REFUSAL_CYCLES
        return self.running and not refusing

    def pose(self, q: Float[np.ndarray, "6"]) -> Pose:
        """Return the TCP's pose at joint positions (rad), base frame."""
        position, R, _ = self.cell.kinematics(q)
        return np.concatenate([position, rotation_vector(R)])

    # Commands.

    def _execute(self, command: int) -> None:
        actions = {
            1: lambda: self._move(_JointMove(self._goal(), *self._pace())),
            3: lambda: self._move(_LineMove(self.cell, self._goal(), *self._pace())),
            8: self._zero_force,
            11: self._servo,
            15: lambda: self._stop(asynchronous=False),
            16: lambda: self._stop(asynchronous=False),
            31: self._protective_stop,
            33: lambda: self._stop(asynchronous=self._int(1) == 1),
            34: lambda: self._stop(asynchronous=self._int(1) == 1),
            35: self._set_watchdog,
            44: self._forward_kinematics,
            _STOP_SCRIPT: self.end,
        }
        if command in actions:
            actions[command]()
        elif command not in _WITHOUT_EFFECT:
            self._refuse(command)

    def _refuse(self, command: int) -> None:
        """Let ur-rtde's call fail: report the program as stopped, or stop if it reads no answer."""
        print(f"REFUSED: the twin does not simulate ur-rtde's command {command}", flush=True)
        if command in _UNANSWERED:
            self._protective_stop()
        else:
            self._refused, self._cycles_refused = command, 0

    def end(self) -> None:
        """End the program; the arm comes to rest."""
        self.running, self.activity = False, None
        self._waiting, self.ints[0] = False, 0
        self.cell.brake(UR5E.hardware.acceleration)

    def report_done(self) -> None:
        """Report a client's own script, for which it would wait 300 s, as done; its call raises."""
        self.ints[0] = _DONE

    def _servo(self) -> None:
        goal = self._goal()
        if not np.isfinite(goal).all():
            self._protective_stop()
            return
        lookahead = min(max(self._double(9), 0.03), 0.2)
        self.activity = _Servo(UR5E.hardware.velocity, goal, lookahead)

    def _move(self, activity: _JointMove | _LineMove) -> None:
        self.activity = activity
        if self._int(1) == 1:
            self._asynchronous = True
            self._started = (self._started + 1) % 128
            self.ints[2] = self._started << 24 | 1 << 15
        else:
            self._waiting = True

    def _stop(self, asynchronous: bool) -> None:
        self._asynchronous, self.ints[2] = False, self._started << 24
        self.activity = _Stop(max(0.1, self._double(0)))
        self._waiting = not asynchronous

    def _set_watchdog(self) -> None:
        self.watchdog = 1 / self._double(0) if self._double(0) > 0 else np.inf

    def _forward_kinematics(self) -> None:
        """Answer the pose of a tool that is shifted from the flange, not turned, at joint positions."""
        position, R, _ = self.cell.kinematics(self._goal())
        shift = np.array([self._double(i) for i in (6, 7, 8)]) - [0, 0, UR5E.tool.tcp_offset]
        self.doubles[:6] = [*position + R @ shift, *rotation_vector(R)]

    # Registers.

    def _pace(self) -> tuple[float, float]:
        return float(np.clip(self._double(6), *_PACE)), float(np.clip(self._double(7), *_PACE))

    def _int(self, index: int) -> int:
        return int(self.inputs[f"input_int_register_{index}"])

    def _double(self, index: int) -> float:
        return float(self.inputs[f"input_double_register_{index}"])

    def _goal(self) -> Float[np.ndarray, "6"]:
        return np.array([self._double(i) for i in range(6)])

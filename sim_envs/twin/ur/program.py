"""The control program that ur-rtde uploads, executed command by command.

The URScript itself is not interpreted. Arguments of a command lie in the input registers, answers
in the output registers; output register 0 is 1 (ready for a command) or 2 (done). Simulated: servoJ,
its stop, the watchdog, zeroFtSensor, forward kinematics and protective stops. Payload and gains are
accepted without effect. All else is refused, by a protective stop.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.rotations import rotation_vector
from touchgoal.control.safety.limits import UR5E
from touchgoal.sim_envs.cell.simulated_cell import DT, NO_OFFSET, SimulatedCell

_READY, DONE = 1, 2
# Numbers of ur-rtde's commands.
_SERVOJ = 11  # streamed, so acknowledged at once
_WITHOUT_EFFECT = {0, 13, 14, 17, 20, 21, 48, 59, 65, 99}  # payload, gains, a kick of the watchdog
_STOP_SCRIPT = 255

_SERVO_ACCELERATION = 40.0  # rad/s^2, the most that ur-rtde lets a client ask for

Joints = Float[np.ndarray, "6"]
Pose = Float[np.ndarray, "6"]  # m, rotation vector (rad)
Target = tuple[Joints, Joints]  # rad, rad/s


# How a UR moves between commands. Each motion's `step` returns the target a millisecond later.


@dataclass
class _Servo:
    """`servoj`: follow a goal (rad) that keeps changing, about `lookahead` s behind it."""

    speed: Joints
    goal: Joints
    lookahead: float
    done = False

    def step(self, q: Joints, dq: Joints) -> Target:
        desired = np.clip((self.goal - q) / self.lookahead, -self.speed, self.speed)
        change = _SERVO_ACCELERATION * DT
        dq = dq + np.clip(desired - dq, -change, change)
        return q + DT * dq, dq


@dataclass
class _Stop:
    """`stopj`: slow down (rad/s^2, leading axis) along the way, then rest."""

    deceleration: float
    done = False

    def step(self, q: Joints, dq: Joints) -> Target:
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
        self.activity: _Servo | _Stop | None = None  # in progress
        # ints: integer output registers; running: false once the program has ended
        self.ints, self.running = [_READY] + [0] * 47, True
        self.doubles = [0.0] * 48  # output registers
        self.watchdog = np.inf  # s without a command after which the program ends
        self._executing = self._waiting = False

    def cycle(self) -> None:
        """Look at the command register once: every 2 ms, and when a package arrives."""
        finished = self.activity is None or self.activity.done
        if self._waiting:
            if not finished:
                return
            self._waiting, self.ints[0] = False, DONE
        command = int(self.inputs["input_int_register_0"])
        if command == _SERVOJ:
            self.ints[0] = _READY
            self._execute(command)
        elif command == 0:
            self._executing, self.ints[0] = False, _READY
        elif not self._executing:
            self._executing, self.ints[0] = True, 0
            self._execute(command)
            if not self._waiting and self.running:
                self.ints[0] = DONE

    def pose(self, q: Joints, offset: Float[np.ndarray, "3"] = NO_OFFSET) -> Pose:
        """Return the TCP's pose at joint positions (rad), or a point's `offset` (m) from it, base frame."""
        position, R, _ = self.cell.kinematics(q, offset)
        return np.concatenate([position, rotation_vector(R)])

    # Commands.

    def _execute(self, command: int) -> None:
        actions = {
            8: self._zero_force,
            _SERVOJ: self._servo,
            16: self._stop,
            31: self._protective_stop,
            35: self._set_watchdog,
            44: self._forward_kinematics,
            _STOP_SCRIPT: self.end,
        }
        if command in actions:
            actions[command]()
        elif command not in _WITHOUT_EFFECT:
            print(f"REFUSED: the twin does not simulate ur-rtde's command {command}", flush=True)
            self._protective_stop()

    def end(self) -> None:
        """End the program; the arm comes to rest."""
        self.running, self.activity = False, None
        self._waiting, self.ints[0] = False, 0
        self.cell.brake(UR5E.hardware.acceleration)

    def _servo(self) -> None:
        goal = self._goal()
        if not np.isfinite(goal).all():
            self._protective_stop()
            return
        lookahead = min(max(self._double(9), 0.03), 0.2)
        self.activity = _Servo(UR5E.hardware.velocity, goal, lookahead)

    def _stop(self) -> None:
        self.activity, self._waiting = _Stop(max(0.1, self._double(0))), True

    def _set_watchdog(self) -> None:
        self.watchdog = 1 / self._double(0) if self._double(0) > 0 else np.inf

    def _forward_kinematics(self) -> None:
        """Answer the pose of a tool that is shifted from the flange, not turned, at joint positions."""
        shift = np.array([self._double(i) for i in (6, 7, 8)]) - [0, 0, UR5E.tool.tcp_offset]
        self.doubles[:6] = self.pose(self._goal(), shift).tolist()

    # Registers.

    def _double(self, index: int) -> float:
        return float(self.inputs[f"input_double_register_{index}"])

    def _goal(self) -> Float[np.ndarray, "6"]:
        return np.array([self._double(i) for i in range(6)])

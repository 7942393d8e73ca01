"""The control program that ur-rtde uploads, as the controller would run it: register by register.

The URScript itself is not interpreted. What it does with each command number is done here: arguments
lie in the input registers, answers in the output registers, and output register 0 says 1 (ready for
a command) or 2 (done).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.rotations import rotation_matrix, rotation_vector
from touchgoal.control.safety.limits import UR5E
from touchgoal.sim_envs.cell.simulated_cell import SimulatedCell
from touchgoal.sim_envs.twin.ur.motion import (
    Activity,
    Force,
    Freedrive,
    JointMove,
    LineMove,
    Servo,
    Speed,
    Stop,
)

_READY, _DONE = 1, 2
_STREAMED = {
    6,
    9,
    10,
    11,
    12,
    24,
    25,
    26,
    27,
    38,
    58,
    66,
    67,
    68,
    69,
    70,
    71,
}  # acknowledged at once
_IGNORED = {0, 13, 14, 17, 20, 21, 48, 59, 65, 99}  # payload, outputs, a kick
_UNANSWERED = {25, 66}  # toolContact, directTorque
_REFUSAL_CYCLES = 250  # 0.5 s at most; a client that waits for an answer has given up long before
_STOP_SCRIPT = 255
_LONGEST_TOOL = 10.0  # m and rad
_END_OF_FREEDRIVE = 5.0  # rad/s^2
_PACE = 1e-3, 40.0  # rad/s or m/s, and those per s
_REACH = 0.85  # m, UR5e data sheet
_FLANGE_TO_TCP = np.array([0.0, 0.0, UR5E.tool.tcp_offset])

Pose = Float[np.ndarray, "6"]  # m, rotation vector (rad)


class UrProgram:
    """One run of the control program.

    Attributes:
        activity: what the arm is doing for it.
        ints, doubles: output registers.
        inputs: the client's input registers by name.
        running: false once it has ended.
    """

    def __init__(
        self,
        cell: SimulatedCell,
        inputs: dict[str, float],
        stop: Callable[[], None],
        zero_force: Callable[[], None],
        wrench: Callable[[], Float[np.ndarray, "6"]],
    ) -> None:
        """What it calls for a protective stop, to zero the force sensor, and to read it."""
        self.cell, self.inputs, self._wrench = cell, inputs, wrench
        self._freedriving = False
        self._protective_stop, self._zero_force = stop, zero_force
        self.activity: Activity | None = None
        self.ints, self.doubles = [0] * 48, [0.0] * 48
        self.ints[0], self.running = _READY, True
        self._refused = self._cycles_refused = 0
        self.watchdog = np.inf  # s without a command after which the program ends
        self.tcp = np.concatenate([_FLANGE_TO_TCP, np.zeros(3)])
        self._executing = self._waiting = self._asynchronous = False
        self._started = 0
        self._kinematics = Kinematics(UR5E.arm, UR5E.tool.tcp_offset)

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
    def says_running(self) -> bool:
        """What clients are told of `running`; not so while a command is refused."""
        refusing = self._refused and self._cycles_refused < _REFUSAL_CYCLES
        return self.running and not refusing

    def pose(self, q: Float[np.ndarray, "6"]) -> Pose:
        """Of the configured TCP at joint positions (rad), base frame."""
        position, R, _ = self.cell.kinematics(q, self._offset())
        return np.concatenate([position, rotation_vector(R @ rotation_matrix(self.tcp[3:]))])

    # Commands.

    def _execute(self, command: int) -> None:
        actions = {
            1: lambda: self._move(JointMove(self._doubles(0), *self._pace())),
            2: lambda: self._move_to_pose(),
            3: lambda: self._move(self._line(self._doubles(0))),
            4: lambda: self._move(self._line(self.pose(self._doubles(0)))),
            6: self._force_mode,
            7: lambda: self._stop(asynchronous=False),
            8: self._zero_force,
            12: lambda: self._servo(self._inverse(self._doubles(0), self.cell.q_d)),
            18: lambda: self._freedrive(True),
            19: lambda: self._freedrive(False),
            52: lambda: self._freedrive(True),
            53: lambda: self._freedrive(False),
            54: lambda: self._answer_int(0 if self._freedriving else 1),
            9: lambda: self._go(Speed(self._doubles(0), self._double(6))),
            10: lambda: self._go(Speed(self._doubles(0), self._double(6), self.cell)),
            11: lambda: self._servo(self._doubles(0)),
            15: lambda: self._stop(asynchronous=False),
            16: lambda: self._stop(asynchronous=False),
            24: lambda: self._servo(self._inverse(self._doubles(0), self.cell.q_d)),
            26: lambda: self._answer([0.002]),
            28: lambda: self._answer(self.pose(self.cell.q_d)),
            29: self._set_tcp,
            30: lambda: self._answer(self._inverse(self._doubles(0), self._doubles(6))),
            31: self._protective_stop,
            33: lambda: self._stop(asynchronous=self._int(1) == 1),
            34: lambda: self._stop(asynchronous=self._int(1) == 1),
            35: self._set_watchdog,
            36: lambda: self._answer_bool(bool(np.linalg.norm(self._doubles(0)[:3]) < _REACH)),
            37: lambda: self._answer_bool(_inside(self._doubles(0))),
            38: lambda: self._answer(self.cell.joint_torque),
            40: lambda: self._answer(self.tcp),
            43: lambda: self._answer(self.pose(self.cell.q)),
            44: self._forward,
            46: lambda: self._answer(self._inverse(self._doubles(0), self.cell.q)),
            47: lambda: self._answer_bool(not self.cell.moving),
            58: lambda: self._answer(self._flange()),
            _STOP_SCRIPT: self.end,
        }
        if command in actions:
            actions[command]()
        elif command not in _IGNORED:
            self._refuse(command)

    def _refuse(self, command: int) -> None:
        """What is not simulated: ur-rtde's call fails, and the program goes on.

        The client gives up on a command when the program is said to have stopped. Some of its calls
        look at no answer; a protective stop tells those.
        """
        print(f"REFUSED: the twin does not simulate ur-rtde's command {command}", flush=True)
        if command in _UNANSWERED:
            self._protective_stop()
        else:
            self._refused, self._cycles_refused = command, 0

    def end(self) -> None:
        """The program ends; the arm comes to rest."""
        self.running, self.activity = False, None
        self._waiting, self.ints[0] = False, 0
        self.cell.brake(UR5E.hardware.acceleration)

    def say_done(self) -> None:
        """Of a script of the client's own, which it waits 300 s for.

        It then uploads the control program again, and its call raises because that does not run within
        5 s: a protective stop is what a UR does to a script that it cannot go on with.
        """
        self.ints[0] = _DONE

    def _go(self, activity: Activity) -> None:
        """Stream: what is going on in the same way goes on with the new numbers."""
        self.activity = activity

    def _servo(self, goal: np.ndarray) -> None:
        if not np.isfinite(goal).all():
            self._protective_stop()
            return
        lookahead = min(max(self._double(9), 0.03), 0.2)
        self._go(Servo(UR5E.hardware.velocity, goal, lookahead))

    def _force_mode(self) -> None:
        """In the base's axes; a task frame that is turned counts as unturned."""
        free = np.array([self._int(i) for i in range(2, 8)]) != 0
        limits = np.abs(self._doubles(12))
        self._go(Force(self.cell, free, self._doubles(6), limits, self._wrench))

    def _freedrive(self, on: bool) -> None:
        self._freedriving = on
        if on:
            self._go(Freedrive(self.cell))
        else:
            self.activity = Stop(_END_OF_FREEDRIVE)

    def _move(self, activity: Activity) -> None:
        self.activity = activity
        if self._int(1) == 1:
            self._asynchronous = True
            self._started = (self._started + 1) % 128
            self.ints[2] = self._started << 24 | 1 << 15
        else:
            self._waiting = True

    def _move_to_pose(self) -> None:
        q = self._inverse(self._doubles(0), self.cell.q_d)
        self._move(JointMove(q, *self._pace()))

    def _stop(self, asynchronous: bool) -> None:
        self._asynchronous, self.ints[2] = False, self._started << 24
        self.activity = Stop(max(0.1, self._double(0)))
        self._waiting = not asynchronous

    def _set_watchdog(self) -> None:
        self.watchdog = 1 / self._double(0) if self._double(0) > 0 else np.inf

    def _set_tcp(self) -> None:
        if (np.abs(self._doubles(0)) < _LONGEST_TOOL).all():
            self.tcp = self._doubles(0)

    def _forward(self) -> None:
        kept, self.tcp = self.tcp, self._doubles(6)
        self._answer(self.pose(self._doubles(0)))
        self.tcp = kept

    # Geometry.

    def _offset(self) -> Float[np.ndarray, "3"]:
        """Of the configured TCP from the hand's own, in the hand frame, m."""
        return self.tcp[:3] - _FLANGE_TO_TCP

    def _target(self, pose: Pose) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Where the hand's own TCP has to be for the configured one to have a pose."""
        R = rotation_matrix(pose[3:]) @ rotation_matrix(self.tcp[3:]).T
        return pose[:3] - R @ self._offset(), R

    def _line(self, pose: Pose) -> LineMove:
        R = rotation_matrix(pose[3:]) @ rotation_matrix(self.tcp[3:]).T
        return LineMove(self.cell, self._offset(), pose[:3], R, *self._pace())

    def _inverse(self, pose: Pose, near: np.ndarray) -> Float[np.ndarray, "6"]:
        """Joint positions, by the nearest way; without a solution a UR stops its program."""
        position, R = self._target(pose)
        if not (np.abs(position) < 2 * _REACH).all() or not np.isfinite(R).all():
            self._protective_stop()
            return self.cell.q_d.copy()
        solution = self._kinematics.solve_ik_near(position, R, near, posture=0.0)
        if not solution.reached:
            print("the twin's UR found no inverse kinematics; protective stop")
            self._protective_stop()
            return self.cell.q_d.copy()
        return solution.q

    def _flange(self) -> Pose:
        position, R, _ = self.cell.kinematics(self.cell.q, -_FLANGE_TO_TCP)
        return np.concatenate([position, rotation_vector(R)])

    # Registers.

    def _pace(self) -> tuple[float, float]:
        """Speed and acceleration of a move, inside what ur-rtde lets through."""
        return tuple(float(np.clip(self._double(i), *_PACE)) for i in (6, 7))  # pyright: ignore

    def _int(self, index: int) -> int:
        return int(self.inputs[f"input_int_register_{index}"])

    def _double(self, index: int) -> float:
        return float(self.inputs[f"input_double_register_{index}"])

    def _doubles(self, index: int) -> Float[np.ndarray, "6"]:
        return np.array([self._double(index + i) for i in range(6)])

    def _answer(self, numbers) -> None:
        self.doubles[: len(numbers)] = [float(number) for number in numbers]

    def _answer_int(self, number: int) -> None:
        self.ints[1] = number

    def _answer_bool(self, yes: bool) -> None:
        self.ints[1] = int(yes)


def _inside(q: Float[np.ndarray, "6"]) -> bool:
    return bool(((q >= UR5E.hardware.lower) & (q <= UR5E.hardware.upper)).all())

"""Franka's own Python client against the address given: joint positions, velocities, torques, recovery.

It answers with one line of JSON; `run.py` judges it.
"""

import json
import sys
from collections.abc import Callable

import numpy as np
import pylibfranka as lib  # pyright: ignore[reportMissingImports]

_DT = 1e-3
_STIFFNESS = np.array([600, 600, 600, 600, 250, 150, 50.0])  # Nm/rad
_DAMPING = np.array([50, 50, 50, 50, 30, 25, 15.0])  # Nms/rad
_THRESHOLDS = [20.0] * 7, [20.0] * 7, [30.0] * 6, [30.0] * 6


def run(control: lib.ActiveControlBase, seconds: float, command: Callable) -> np.ndarray:
    """Send commands for some seconds; return the last joint positions."""
    time = 0.0
    while True:
        state, duration = control.readOnce()
        time += duration.to_sec()
        order = command(time, state)
        order.motion_finished = time >= seconds
        control.writeOnce(order)
        if time >= seconds:
            return np.array(state.q)


def smooth(time: float, seconds: float) -> float:
    """Return a smooth step from 0 to 1, at rest at both ends."""
    share = min(time / seconds, 1.0)
    return share**3 * (10 - 15 * share + 6 * share**2)


def main(address: str) -> None:
    """Run every mode on one arm."""
    result: dict[str, object] = {}
    robot = lib.Robot(address, lib.RealtimeConfig.kIgnore)
    robot.automatic_error_recovery()
    robot.set_collision_behavior(*_THRESHOLDS)
    mode = lib.ControllerMode.JointImpedance
    state = robot.read_once()
    result["gravity"] = float(np.abs(robot.load_model().gravity(state)).max())

    def position(time: float, state: lib.RobotState) -> lib.JointPositions:
        del state
        return lib.JointPositions((start + 0.1 * smooth(time, 2.0)).tolist())

    start = np.array(state.q_d)
    run(robot.start_joint_position_control(mode), 2.0, position)
    result["position"] = (np.array(robot.read_once().q) - start).tolist()

    def velocity(time: float, state: lib.RobotState) -> lib.JointVelocities:
        del state
        return lib.JointVelocities([-0.2 * np.sin(np.pi * min(time, 1.0)) ** 2] * 7)

    before = np.array(robot.read_once().q)
    run(robot.start_joint_velocity_control(mode), 1.0, velocity)
    result["velocity"] = (np.array(robot.read_once().q) - before).tolist()

    model = robot.load_model()

    def torque(time: float, state: lib.RobotState) -> lib.Torques:
        goal = hold + 0.05 * smooth(time, 1.5)
        pull = _STIFFNESS * (goal - state.q) - _DAMPING * np.array(state.dq)
        return lib.Torques((pull + np.array(model.coriolis(state))).tolist())

    hold = np.array(robot.read_once().q)
    run(robot.start_torque_control(), 2.0, torque)
    result["torque"] = (np.array(robot.read_once().q) - hold).tolist()

    try:  # a jump that no arm can follow
        run(
            robot.start_joint_position_control(mode),
            1.0,
            lambda time, state: lib.JointPositions((np.array(state.q_d) + 0.2).tolist()),
        )
        result["error"] = ""
    except lib.ControlException as error:
        result["error"] = str(error)
    robot.automatic_error_recovery()
    start = np.array(robot.read_once().q_d)
    run(robot.start_joint_position_control(mode), 2.0, position)
    result["recovered"] = (np.array(robot.read_once().q) - start).tolist()
    print(json.dumps(result))


if __name__ == "__main__":
    main(sys.argv[1])

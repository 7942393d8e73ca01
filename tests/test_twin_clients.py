"""The twin's controllers through their makers' clients: libfranka (franky) and ur-rtde."""

import time
from typing import Any

import numpy as np
import pytest
from running_twin import RunningTwin, client

from touchgoal.control.safety.limits import FR3
from touchgoal.sim_envs.twin.franka.limits import Setpoint, joint_fault

HOME = [0.0, -0.3, 0.0, -2.2, 0.0, 1.9, 0.785]


def connect(address: str):
    """franky, with the FR3's limits in place of the Panda's; the speed is safe in any position."""
    import franky

    robot = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
    robot.joint_velocity_limit.set([2, 1, 1.5, 1.25, 2.1, 1.5, 2.1])
    robot.joint_acceleration_limit.set([9.9, 7.5, 9.9, 9.9, 9.9, 9.9, 9.9])
    robot.joint_jerk_limit.set([4900, 3700, 4900, 4900, 4900, 4900, 4900])
    robot.recover_from_errors()
    return robot


def through_franky(function: Any, fr3: RunningTwin, *arguments: object) -> dict[str, Any]:
    return client(function, fr3.cell.address, HOME, *arguments, using=connect)


def moves(address: str, home: list[float]) -> dict:
    """Full-speed moves; what the arm says to the limits of another arm, and to going too far."""
    import franky

    robot = connect(address)

    def refused(target: np.ndarray) -> str:
        try:
            robot.move(franky.JointMotion(target.tolist()))
        except franky.ControlException as error:
            robot.recover_from_errors()
            return str(error)
        return ""

    robot.joint_acceleration_limit.set([15.0, 7.5, 10, 12.5, 15, 20, 20])  # the Panda's
    panda = refused(np.array(home) + 0.4)
    robot.joint_acceleration_limit.set([9.9, 7.5, 9.9, 9.9, 9.9, 9.9, 9.9])

    def settle(seconds: float = 0.2) -> None:
        end = robot.state.time.to_sec() + seconds  # of the arm, whose time may pass more slowly
        while robot.state.time.to_sec() < end:
            time.sleep(0.01)

    errors, rng = [], np.random.default_rng(0)
    for i in range(4):
        target = np.array(home) + (rng.uniform(-0.5, 0.5, 7) if i % 2 else 0)
        robot.move(franky.JointMotion(target.tolist()))
        settle()
        errors.append(float(np.abs(np.array(robot.state.q) - target).max()))
    robot.move(franky.JointMotion(home))
    settle()
    pose = np.array(robot.state.O_T_EE.translation)
    down = franky.Affine([0, 0, 0.03])
    robot.move(franky.CartesianMotion(down, franky.ReferenceType.Relative))
    settle()
    fell = pose - np.array(robot.state.O_T_EE.translation)
    robot.move(franky.JointMotion(home))
    before = np.array(robot.state.q)
    robot.move(franky.JointVelocityMotion([0.2, 0, 0, 0, 0, 0, 0], franky.Duration(300)))
    turned = np.array(robot.state.q) - before
    held = np.inf
    stiffness = np.array([600, 600, 600, 600, 250, 150, 50.0])
    with franky.JointImpedanceTracker(robot, stiffness=stiffness) as tracker:
        tracker.set_target(np.array(home), np.zeros(7))
        settle(0.5)
        held = float(np.abs(np.array(robot.state.q) - home).max())
    far = refused(np.array([2.9, *home[1:]]))
    ways = {"fell": fell.tolist(), "turned": turned.tolist()}
    return {"panda": panda, "far": far, "errors": errors, "held": held, **ways}


@pytest.mark.realtime
def test_franka_holds_clients_to_its_limits(fr3: RunningTwin) -> None:
    fr3.begin("reset 3")
    result = through_franky(moves, fr3)
    assert "joint_motion_generator" in result["panda"] and "discontinuity" in result["panda"]
    assert "joint_motion_generator_" in result["far"] and "limits_violation" in result["far"]
    assert max(result["errors"]) < 2e-3
    np.testing.assert_allclose(result["fell"], [0, 0, 0.03], atol=2e-3)
    assert 0.05 < result["turned"][0] < 0.07 and np.abs(result["turned"][1:]).max() < 3e-3
    assert result["held"] < 0.02
    worst = fr3.ask("truth")["worst"]
    assert worst["excess"] <= 0 and worst["speed"] < 1


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("end", [0, 1])
def test_speeds_are_refused_above_the_range_of_their_place(joint: int, end: int) -> None:
    limits, zero = FR3.hardware, np.zeros(7)
    for share in np.linspace(0.02, 0.98, 25):  # near the ends of the range less is allowed
        q = FR3.arm.home.copy()
        q[joint] = limits.lower[joint] + share * (limits.upper - limits.lower)[joint]
        speed = limits.speed_range(q)[end][joint]
        for factor, fault in ((1.005, None), (1.02, "velocity_limits_violation")):
            dq = zero.copy()
            dq[joint] = factor * speed + (2e-3 * np.sign(speed) if fault else 0.0)
            found = joint_fault(Setpoint(q, dq, zero), Setpoint(q, dq, zero), cartesian=False)
            if abs(speed) > 0.01:
                assert found == (fault and f"joint_motion_generator_{fault}"), (share, factor)


# ---- UR


def drives(address: str) -> dict:
    """Moves, stops, servoes at three rates, and falls silent."""
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)

    def at() -> np.ndarray:
        return np.array(receive.getActualQ())

    start = at()
    result: dict[str, Any] = {}
    control.moveJ((start + 0.2).tolist(), 1.0, 2.0)
    result["move"] = float(np.abs(at() - start - 0.2).max())
    control.moveJ((start - 0.4).tolist(), 0.5, 2.0, True)
    time.sleep(0.4)
    control.stopJ(5.0)
    stopped = at()
    time.sleep(0.2)
    result["stop"] = float(np.abs(at() - stopped).max())
    result["short"] = float(np.abs(at() - start + 0.4).max())
    control.moveJ(start.tolist(), 1.0, 2.0)
    result["servo"] = []
    for rate in (20, 125, 500):
        began, worst, taken = time.monotonic(), 0.0, True
        while (now := time.monotonic() - began) < 0.8:
            goal = start.copy()
            goal[0] += 0.1 * np.sin(2 * now)
            taken &= control.servoJ(goal.tolist(), 0, 0, 1 / rate, 0.1, 300)
            worst = max(worst, abs(at()[0] - goal[0]))
            time.sleep(max(0.0, 1 / rate - (time.monotonic() - began - now)))
        control.servoStop()
        result["servo"].append([taken, worst])
    control.moveJ(start.tolist(), 1.0, 2.0)
    pose = receive.getActualTCPPose()
    control.moveL([*pose[:2], pose[2] - 0.05, *pose[3:]], 0.2, 0.5)
    result["line"] = (np.array(receive.getActualTCPPose())[:3] - pose[:3]).tolist()
    control.setWatchdog(10)
    for _ in range(10):
        control.kickWatchdog()
        time.sleep(0.03)
    result["kicked"] = control.isProgramRunning()
    time.sleep(1.0)
    result["silent"] = control.isProgramRunning()
    return result


@pytest.mark.realtime
def test_ur_moves_servoes_and_watches(ur5e: RunningTwin) -> None:
    result = client(drives, ur5e.cell.address)
    assert result["move"] < 2e-3 and result["stop"] < 2e-3 and result["short"] > 0.1
    for taken, worst in result["servo"]:
        assert taken and worst < 0.1  # rad behind a goal at 0.2 rad/s, on a loaded machine
    np.testing.assert_allclose(result["line"], [0, 0, -0.05], atol=2e-3)
    assert result["kicked"] and not result["silent"]
    assert ur5e.ask("truth")["worst"]["excess"] <= 0

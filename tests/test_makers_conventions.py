"""Signs, frames and units of both arms, each against its maker's documents alone.

Driver and twin are both ours: where they share a mistake, their tests agree. Here the numbers on the
wire are read by the maker's client library, and what they should be is written down from the maker's
documents, without our kinematics.
"""

import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from running_twin import RunningTwin, client

from touchgoal.control.arms import franka
from touchgoal.control.cell.connection import connect_arm
from touchgoal.control.cell.limits import cell_limits
from touchgoal.control.safety.limits import UR5E
from touchgoal.sim_envs.twin.franka.limits import estimate_sent

PUSH = np.array([6.0, -8.0, 5.0])  # N, of the environment on the hand


def dh(rows: list[tuple[float, float, float]], q: np.ndarray, craig: bool) -> np.ndarray:
    """Denavit-Hartenberg transforms (a, d, alpha) multiplied up, in Craig's or the classic way."""
    T = np.eye(4)
    for (a, d, alpha), theta in zip(rows, q, strict=True):
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        turn = np.array([[ct, -st, 0, 0], [st, ct, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]])
        tilt = np.array([[1, 0, 0, a], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]])
        T = T @ (tilt @ turn if craig else turn @ tilt)
    return T


def reads_franka(address: str, home: list[float]) -> dict:
    """The state as libfranka gives it."""
    import franky

    state = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore).state
    return {
        "O": list(state.O_F_ext_hat_K),
        "K": list(state.K_F_ext_hat_K),
        "q": list(state.q),
        "O_T_EE": np.asarray(state.O_T_EE.matrix).tolist(),
        "F_T_EE": np.asarray(state.F_T_EE.matrix).tolist(),
    }


def test_franka_signs_frames_and_units(fr3: RunningTwin) -> None:
    """robot_state.h: "Forces applied by the robot to the environment are positive"; O_T_EE = O_T_F F_T_EE.

    The FR3's Denavit-Hartenberg table (Craig's): Franka's documentation, robot and interface specs.
    """
    fr3.begin("reset 3")
    fr3.ask("nudge {} {} {} 600".format(*PUSH))
    state = client(reads_franka, fr3.cell.address, [])
    fr3.ask("nudge 0 0 0 0")
    np.testing.assert_allclose(state["O"][:3], -PUSH, atol=0.2)
    O_T_EE = np.array(state["O_T_EE"])
    np.testing.assert_allclose(O_T_EE[:3, :3] @ state["K"][:3], state["O"][:3], atol=0.01)
    quarter = np.pi / 2
    table = [
        (0, 0.333, 0),
        (0, 0, -quarter),
        (0, 0.316, quarter),
        (0.0825, 0, quarter),
        (-0.0825, 0.384, -quarter),
        (0, 0, quarter),
        (0.088, 0, quarter),
        (0, 0.107, 0),  # the flange
    ]
    q = np.array([*state["q"], 0.0])
    O_T_F = dh(table, q, craig=True)
    np.testing.assert_allclose(O_T_EE, O_T_F @ np.array(state["F_T_EE"]), atol=1e-4)


def test_near_a_singularity_the_estimate_is_zero_on_the_wire_and_unknown_here() -> None:
    """robot_state.h: "Becomes [0,0,0,0,0,0] when near or in a singularity"."""
    wrench, regular = np.arange(1.0, 7.0), np.eye(6, 7)
    np.testing.assert_allclose(estimate_sent(wrench, regular), -wrench, atol=1e-5)
    singular = estimate_sent(wrench, np.diag([1, 1, 1, 1, 1, 1e-3]) @ regular)
    assert not singular.any()
    assert np.isnan(franka.wrench_on_robot(singular)).all()
    np.testing.assert_array_equal(franka.wrench_on_robot(-wrench), wrench)


def reads_ur(address: str) -> dict:
    """Return the state as RTDE gives it."""
    from rtde_receive import RTDEReceiveInterface

    receive = RTDEReceiveInterface(address)
    time.sleep(0.3)
    state = {
        "force": receive.getActualTCPForce(),
        "pose": receive.getActualTCPPose(),
        "q": receive.getActualQ(),
    }
    receive.disconnect()
    return state


@pytest.mark.realtime
def test_ur_signs_frames_and_units(ur5e: RunningTwin) -> None:
    """RTDE guide: actual_TCP_pose is x, y, z, rx, ry, rz in the base; UR about get_tcp_force: "feedback of
    forces acting on the end point of the TCP". Denavit-Hartenberg: UR's article 45257, e-Series.
    """
    ur5e.begin("reset 3")
    ur5e.ask("nudge {} {} {} 600".format(*PUSH))
    state = client(reads_ur, ur5e.cell.address)
    ur5e.ask("nudge 0 0 0 0")
    np.testing.assert_allclose(state["force"][:3], PUSH, atol=0.5)
    quarter = np.pi / 2
    table = [
        (0, 0.1625, quarter),
        (-0.425, 0, 0),
        (-0.3922, 0, 0),
        (0, 0.1333, quarter),
        (0, 0.0997, -quarter),
        (0, 0.0996, 0),
    ]
    flange = dh(table, np.array(state["q"]), craig=False)
    position, vector = np.array(state["pose"][:3]), np.array(state["pose"][3:])
    angle = np.linalg.norm(vector)
    K = np.cross(np.eye(3), vector / angle)
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K  # Rodrigues
    np.testing.assert_allclose(R, flange[:3, :3], atol=1e-4)
    tool = flange[:3, :3].T @ (position - flange[:3, 3])
    np.testing.assert_allclose(tool, [0, 0, UR5E.tool.tcp_offset], atol=1e-4)


@pytest.mark.parametrize("name", ["fr3", pytest.param("ur5e", marks=pytest.mark.realtime)])
def test_drivers_say_what_is_done_to_the_robot(name: str, request: pytest.FixtureRequest) -> None:
    """And where its controller has the tool. A UR's sensor is zeroed at the start: it feels only later pushes."""
    twin: RunningTwin = request.getfixturevalue(name)
    twin.begin("reset 3")
    safety = replace(twin.cell.safety, state_timeout=1.0)
    with closing(connect_arm(replace(twin.cell, lock_step=False, safety=safety))) as arm:
        before = arm.read()
        twin.ask("nudge {} {} {} 600".format(*PUSH))
        twin_time = twin.ask("truth")["time"]
        while twin.ask("truth")["time"] < twin_time + 0.3:
            pass
        pushed = arm.read()
        twin.ask("nudge 0 0 0 0")
    np.testing.assert_allclose((pushed.wrench - before.wrench)[:3], PUSH, atol=0.5)
    robot = cell_limits(twin.cell)
    nominal, _ = robot.kinematics().forward(before.q)
    assert before.tcp is not None
    np.testing.assert_allclose(before.tcp, nominal, atol=1e-4)

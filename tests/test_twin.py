"""The digital twin through the makers' own client libraries, over the wire.

Every client runs in a process of its own with a time-out: franky waits for ever for a slot that is
taken, and ur-rtde crashes when it reconnects by itself.
"""

import inspect
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import serial

from touchgoal.control.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze, BeadMazeConfig
from touchgoal.sim_envs.pick_place import PickPlace, PickPlaceConfig
from touchgoal.sim_envs.scene import SceneConfig
from touchgoal.sim_envs.twin.cell import Cell
from touchgoal.sim_envs.twin.faults import ask
from touchgoal.sim_envs.twin.serial_ports import NEWTONS_PER_COUNT, ZERO

pytestmark = pytest.mark.realtime

HOME = [0.0, -0.3, 0.0, -2.2, 0.0, 1.9, 0.785]
FR3 = ["--lock-step", "--arm", "fr3", "--object", "wooden_block", "--seed", "3"]
UR5E = ["--arm", "ur5e", "--object", "wooden_block", "--seed", "3"]


def start(arguments: list[str], out: Path, n: int) -> tuple[subprocess.Popen, dict]:
    """A twin at an address of its own, once it serves."""
    host = f"127.{10 + n}.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    command = [sys.executable, "-m", "touchgoal.launch", "twin", "--port", "0"]
    twin = subprocess.Popen(
        [*command, "--host", host, "--out", str(out), *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not (out / "rig.json").exists():
        assert twin.poll() is None and time.monotonic() < deadline, twin.communicate()[1]
        time.sleep(0.05)
    return twin, json.loads((out / "rig.json").read_text())


def finish(twin: subprocess.Popen) -> None:
    twin.send_signal(signal.SIGINT)
    assert twin.wait(20) == 0, twin.communicate()[1]


@pytest.fixture(scope="module")
def fr3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict]:
    twin, rig = start(FR3, tmp_path_factory.mktemp("fr3"), 0)
    yield rig
    finish(twin)


@pytest.fixture(scope="module")
def ur5e(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict]:
    cameras = ["--env.cameras", "front", "--env.no-tactile"]
    twin, rig = start([*UR5E, *cameras], tmp_path_factory.mktemp("ur5e"), 1)
    yield rig
    finish(twin)


def at_rest(rig: dict) -> dict:
    """The truth once the arm is at rest."""
    deadline = time.monotonic() + 10
    while (truth := ask(rig["faults"], "truth"))["rest"] < 0.1:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return truth


def begin(rig: dict, line: str) -> None:
    """Reset the cell once the arm is at rest."""
    at_rest(rig)
    ask(rig["faults"], line)


def client(function: Callable, *arguments: object, seconds: float = 150) -> dict:
    """What a function returns in a process of its own."""
    source = inspect.getsource(connect) + inspect.getsource(function)
    program = (
        f"import json, sys, time\nimport numpy as np\n{source}\n"
        f"print(json.dumps({function.__name__}(*json.loads(sys.argv[1]))), flush=True)\n"
        "import os; os._exit(0)"  # ur-rtde's threads may outlive the interpreter
    )
    done = subprocess.run(
        [sys.executable, "-c", program, json.dumps(arguments)],
        capture_output=True,
        text=True,
        timeout=seconds,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


# The cell, without a wire.


@pytest.mark.parametrize("arm", ["fr3", "ur5e"])
def test_arm_follows_without_lag(arm: str) -> None:
    scene = SceneConfig(arm=arm)  # type: ignore[arg-type]
    cell = Cell(PickPlace(PickPlaceConfig(cameras=(), tactile=False, scene=scene)), 3, {})
    start, error = cell.q_d.copy(), 0.0
    for _ in range(1500):
        phase = 4 * (cell.time + 1e-3)  # 0.8 rad/s and 3.2 rad/s^2 at most
        cell.follow(start + 0.2 * (1 - np.cos(phase)), np.full(len(start), 0.8 * np.sin(phase)))
        cell.step()
        error = max(error, float(np.abs(cell.q - cell.q_d).max()))
    assert error < 5e-3  # 0.08 rad without feed-forward
    cell.brake(np.full(len(start), 10.0))
    for _ in range(300):
        cell.step()
    assert not cell.moving and cell.worst.excess <= 0


def test_fixture_waits_for_the_first_grasp() -> None:
    maze = BeadMazeConfig(split="validation", n_wires=20, tactile=False)
    cell = Cell(BeadMaze(maze), 3, {})
    for _ in range(2000):
        cell.step()
    fixture = cell.env.model.equality("fixture").id
    assert cell.env.data.eq_active[fixture]
    cell.grasp(0.0, 0.1, 10.0)
    for _ in range(1000):
        cell.step()
    assert not cell.env.data.eq_active[fixture] and not cell.failures
    np.testing.assert_allclose(cell.truth()["pad_forces"], 10.0, rtol=0.05)


# The Franka control interface, through libfranka.


def connect(address: str):
    """franky, with the FR3's limits in place of the Panda's; the speed is safe in any position."""
    import franky

    robot = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
    robot.joint_velocity_limit.set([2, 1, 1.5, 1.25, 2.1, 1.5, 2.1])
    robot.joint_acceleration_limit.set([9.9, 7.5, 9.9, 9.9, 9.9, 9.9, 9.9])
    robot.joint_jerk_limit.set([4900, 3700, 4900, 4900, 4900, 4900, 4900])
    robot.recover_from_errors()
    return robot


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
    errors, rng = [], np.random.default_rng(0)
    for i in range(4):
        target = np.array(home) + (rng.uniform(-0.5, 0.5, 7) if i % 2 else 0)
        robot.move(franky.JointMotion(target.tolist()))
        time.sleep(0.2)
        errors.append(float(np.abs(np.array(robot.state.q) - target).max()))
    robot.move(franky.JointMotion(home))
    time.sleep(0.2)
    pose = np.array(robot.state.O_T_EE.translation)
    down = franky.Affine([0, 0, 0.03])
    robot.move(franky.CartesianMotion(down, franky.ReferenceType.Relative))
    time.sleep(0.2)
    fell = pose - np.array(robot.state.O_T_EE.translation)
    robot.move(franky.JointMotion(home))
    before = np.array(robot.state.q)
    robot.move(franky.JointVelocityMotion([0.2, 0, 0, 0, 0, 0, 0], franky.Duration(300)))
    turned = np.array(robot.state.q) - before
    held = np.inf
    stiffness = np.array([600, 600, 600, 600, 250, 150, 50.0])
    with franky.JointImpedanceTracker(robot, stiffness=stiffness) as tracker:
        tracker.set_target(np.array(home), np.zeros(7))
        time.sleep(0.5)
        held = float(np.abs(np.array(robot.state.q) - home).max())
    far = refused(np.array([2.9, *home[1:]]))
    return {
        "panda": panda,
        "far": far,
        "errors": errors,
        "fell": fell.tolist(),
        "turned": turned.tolist(),
        "held": held,
    }


def test_franka_holds_clients_to_its_limits(fr3: dict) -> None:
    begin(fr3, "reset 3")
    said = client(moves, fr3["address"], HOME)
    assert "joint_motion_generator" in said["panda"] and "discontinuity" in said["panda"]
    assert "joint_motion_generator_" in said["far"] and "limits_violation" in said["far"]
    assert max(said["errors"]) < 2e-3
    np.testing.assert_allclose(said["fell"], [0, 0, 0.03], atol=2e-3)
    assert 0.05 < said["turned"][0] < 0.07 and np.abs(said["turned"][1:]).max() < 3e-3
    assert said["held"] < 0.02
    worst = ask(fr3["faults"], "truth")["worst"]
    assert worst["excess"] <= 0 and worst["speed"] < 1


def picks(address: str, home: list[float], position: list[float], yaw: float) -> dict:
    """Closes on air, then on the object, and lifts it."""
    import franky

    robot, gripper = connect(address), franky.Gripper(address)
    robot.relative_dynamics_factor = 0.6
    robot.move(franky.JointMotion(home))
    air = gripper.grasp(0.03, 0.1, 20.0)
    opened = gripper.open(0.1)
    half = [np.cos(yaw / 2), np.sin(yaw / 2), 0.0, 0.0]  # x, y, z, w: about x, then yaw
    for height in (0.12, 0.0):
        at = franky.Affine([position[0], position[1], position[2] + height], half)
        robot.move(franky.CartesianMotion(at))
    start = time.monotonic()
    grasped = gripper.grasp(0.04, 0.04, 20.0, 0.04, 0.04)
    took = time.monotonic() - start
    up = franky.Affine([0, 0, -0.12])
    robot.move(franky.CartesianMotion(up, franky.ReferenceType.Relative))
    time.sleep(0.5)
    return {
        "air": air,
        "opened": opened,
        "grasped": grasped and gripper.is_grasped,
        "took": took,
        "width": gripper.width,
        "force": list(robot.state.O_F_ext_hat_K),
    }


def yaw_of(pose: list[float]) -> float:
    """Hand yaw that closes across a box, within an eighth of a turn."""
    w, x, y, z = pose[3:]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return float((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def test_franka_grasps_what_is_there(fr3: dict) -> None:
    begin(fr3, 'reset 3 {"object": "wooden_block", "mass": 0.1}')
    pose = ask(fr3["faults"], "truth")["layout"]["object"]
    position = [*pose[:2], max(pose[2], 0.0185)]
    said = client(picks, fr3["address"], HOME, position, yaw_of(pose))
    assert not said["air"] and said["opened"] and said["grasped"]
    truth = ask(fr3["faults"], "truth")
    assert truth["layout"]["object"][2] > 0.1
    np.testing.assert_allclose(truth["pad_forces"], 20.0, rtol=0.05)
    assert abs(truth["width"] - said["width"]) < 1e-4
    assert abs(said["force"][2] + 0.1 * 9.81) < 0.1
    assert said["took"] > 0.5 * (0.08 - said["width"]) / 0.04  # it keeps to the speed asked for


def suffers(address: str, home: list[float]) -> dict:
    """Moves slowly until something happens; says what, and whether the arm goes on afterwards."""
    import franky

    robot = connect(address)
    robot.set_collision_behavior([20.0] * 7, [20.0] * 6)
    said, speed = "", [0.05, 0, 0, 0, 0, 0, 0]
    try:
        robot.move(franky.JointVelocityMotion(speed, franky.Duration(20_000)))
    except franky.ControlException as error:
        said = str(error)
    mode = robot.state.robot_mode.name
    try:
        robot.move(franky.JointVelocityMotion(speed, franky.Duration(100)))
        rejected = ""
    except (franky.CommandException, franky.ControlException) as error:
        rejected = str(error)
    try:
        recovered = robot.recover_from_errors()
    except franky.CommandException:
        recovered = False
    if recovered:
        robot.relative_dynamics_factor = 0.5
        robot.move(franky.JointMotion(home))
    return {"said": said, "mode": mode, "rejected": rejected, "recovered": recovered}


@pytest.mark.parametrize(
    ("fault", "error", "mode", "recovers"),
    [
        ("nudge 0 60 0 0.3", "cartesian_reflex", "Reflex", True),
        ("error joint_reflex", "joint_reflex", "Reflex", True),
        ("freeze 0.3", "communication_constraints_violation", "Reflex", True),
        ("stop-button on", "safety function", "UserStopped", False),
    ],
)
def test_franka_stops_for_a_fault(
    fr3: dict, fault: str, error: str, mode: str, recovers: bool
) -> None:
    begin(fr3, "reset 3")
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(client, suffers, fr3["address"], HOME)
        while ask(fr3["faults"], "truth")["rest"] > 0 and not running.done():
            time.sleep(0.02)
        ask(fr3["faults"], fault)
        said = running.result()
    ask(fr3["faults"], "stop-button off")
    assert error in said["said"] and said["mode"] == mode
    assert "rejected" in said["rejected"] and said["recovered"] == recovers
    assert at_rest(fr3)["worst"]["excess"] <= 0


def two_moves(address: str, home: list[float]) -> dict:
    import franky

    robot = connect(address)
    robot.move(franky.JointMotion(home))
    robot.move(franky.JointMotion((np.array(home) + 0.2).tolist()))
    return {}


def test_lock_step_repeats(fr3: dict) -> None:
    ends = []
    for _ in range(2):
        begin(fr3, "reset 5")
        client(two_moves, fr3["address"], HOME)
        ends.append(ask(fr3["faults"], "truth")["q"])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-4)


# A UR controller, through ur-rtde.


def drives(address: str) -> dict:
    """Moves, stops, servoes at three rates, and falls silent."""
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)

    def at() -> np.ndarray:
        return np.array(receive.getActualQ())

    start, said = at(), {}
    control.moveJ((start + 0.2).tolist(), 1.0, 2.0)
    said["move"] = float(np.abs(at() - start - 0.2).max())
    control.moveJ((start - 0.4).tolist(), 0.5, 2.0, True)
    time.sleep(0.4)
    control.stopJ(5.0)
    stopped = at()
    time.sleep(0.2)
    said["stop"] = float(np.abs(at() - stopped).max())
    said["short"] = float(np.abs(at() - start + 0.4).max())
    control.moveJ(start.tolist(), 1.0, 2.0)
    said["servo"] = []
    for rate in (20, 125, 500):
        began, worst, taken = time.monotonic(), 0.0, True
        while (now := time.monotonic() - began) < 0.8:
            goal = start.copy()
            goal[0] += 0.1 * np.sin(2 * now)
            taken &= control.servoJ(goal.tolist(), 0, 0, 1 / rate, 0.1, 300)
            worst = max(worst, abs(at()[0] - goal[0]))
            time.sleep(max(0.0, 1 / rate - (time.monotonic() - began - now)))
        control.servoStop()
        said["servo"].append([taken, worst])
    control.moveJ(start.tolist(), 1.0, 2.0)
    control.speedJ([0.3, 0, 0, 0, 0, 0], 2.0, 0.5)
    time.sleep(0.5)
    control.speedStop()
    said["speed"] = (at() - start).tolist()
    pose = receive.getActualTCPPose()
    control.moveL([*pose[:2], pose[2] - 0.05, *pose[3:]], 0.2, 0.5)
    said["line"] = (np.array(receive.getActualTCPPose())[:3] - pose[:3]).tolist()
    forward = control.getForwardKinematics(at().tolist(), control.getTCPOffset())
    said["forward"] = float(np.abs(np.array(forward) - receive.getActualTCPPose())[:3].max())
    said["inside"] = [
        control.isJointsWithinSafetyLimits(q) for q in ([0.0] * 6, [0, 0, 4, 0, 0, 0])
    ]
    control.setWatchdog(10)
    for _ in range(10):
        control.kickWatchdog()
        time.sleep(0.03)
    said["kicked"] = control.isProgramRunning()
    time.sleep(1.0)
    said["silent"] = control.isProgramRunning()
    return said


def test_ur_moves_servoes_and_watches(ur5e: dict) -> None:
    said = client(drives, ur5e["address"])
    assert said["move"] < 2e-3 and said["stop"] < 2e-3 and said["short"] > 0.1
    for taken, worst in said["servo"]:
        assert taken and worst < 0.1  # rad behind a goal at 0.2 rad/s, on a loaded machine
    assert said["speed"][0] > 0.05 and np.abs(said["speed"][1:]).max() < 2e-3
    np.testing.assert_allclose(said["line"], [0, 0, -0.05], atol=2e-3)
    assert said["forward"] < 1e-3 and said["inside"] == [True, False]
    assert said["kicked"] and not said["silent"]
    assert ask(ur5e["faults"], "truth")["worst"]["excess"] <= 0


def protected(address: str, reset: str) -> dict:
    """Servoes into a protective stop, unlocks it after 5 s, and goes on; then connects anew."""
    import socket

    from dashboard_client import DashboardClient
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)
    q = receive.getActualQ()

    def order(line: str) -> None:
        host, _, port = reset.rpartition(":")
        with socket.create_connection((host, int(port))) as faults:
            faults.sendall(line.encode() + b"\n")
            faults.recv(1000)

    order("error protective_stop")
    deadline = time.monotonic() + 5
    while control.servoJ(q, 0, 0, 0.008, 0.1, 300) and time.monotonic() < deadline:
        time.sleep(0.008)
    said = {"refused": time.monotonic() < deadline}
    while not receive.isProtectiveStopped() and time.monotonic() < deadline:
        time.sleep(0.01)
    said["noticed"] = receive.isProtectiveStopped()
    dashboard = DashboardClient(address)
    dashboard.connect()
    try:
        dashboard.unlockProtectiveStop()
        said["early"] = ""
    except RuntimeError as error:
        said["early"] = str(error)
    deadline = time.monotonic() + 20
    while receive.isProtectiveStopped() and time.monotonic() < deadline:
        time.sleep(0.5)
        try:
            dashboard.unlockProtectiveStop()
        except RuntimeError:
            pass
        time.sleep(0.1)
    said["unlocked"] = not receive.isProtectiveStopped()
    order("stop-button on")
    time.sleep(0.3)
    said["emergency"] = [receive.isEmergencyStopped(), dashboard.safetystatus()]
    order("stop-button off")
    dashboard.powerOn()
    dashboard.brakeRelease()
    dashboard.disconnect()
    control.disconnect()
    receive.disconnect()
    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)
    goal = (np.array(receive.getActualQ()) + 0.05).tolist()
    control.moveJ(goal, 1.0, 1.0)
    said["anew"] = float(np.abs(np.array(receive.getActualQ()) - goal).max())
    return said


def test_ur_protective_stop_and_reconnection(ur5e: dict) -> None:
    said = client(protected, ur5e["address"], ur5e["faults"])
    assert said["refused"] and said["noticed"] and "5s" in said["early"] and said["unlocked"]
    assert said["emergency"] == [True, "Safetystatus: ROBOT_EMERGENCY_STOP"]
    assert said["anew"] < 2e-3


def places(address: str, port: str, pick: list[float], place: list[float], yaw: float) -> dict:
    """Picks and places through ur-rtde, with the gripper's Modbus frames written by hand."""
    import struct

    import serial
    from rtde_control import RTDEControlInterface

    control = RTDEControlInterface(address)
    gripper = serial.Serial(port, 115200, timeout=0.5)

    def check(frame: bytes) -> bytes:
        value = 0xFFFF
        for byte in frame:
            value ^= byte
            for _ in range(8):
                value = value >> 1 ^ (0xA001 if value & 1 else 0)
        return frame + struct.pack("<H", value)

    def grip(position: int) -> int:
        orders = struct.pack(">BBHHB", 9, 16, 1000, 3, 6) + bytes([9, 0, 0, position, 255, 20])
        gripper.write(check(orders))
        assert gripper.read(8) == check(orders[:6])
        deadline = time.monotonic() + 10
        while time.monotonic() < deadline:
            gripper.write(check(struct.pack(">BBHH", 9, 4, 2000, 3)))
            answer = gripper.read(11)
            assert answer == check(answer[:-2])
            if answer[3] >> 6:  # no longer moving
                return answer[3] >> 6
            time.sleep(0.05)
        return 0

    # Pointing down, turned by yaw: half a turn about an axis in the table's plane.
    down = [np.pi * np.cos(yaw / 2), np.pi * np.sin(yaw / 2), 0.0]

    def go(position: list[float], height: float, speed: float) -> None:
        pose = [position[0], position[1], position[2] + height, *down]
        control.moveL(pose, speed, 1.0)

    said = {"air": grip(3)}
    go(pick, 0.12, 0.5)
    go(pick, 0.0, 0.2)
    said["object"] = grip(230)
    go(pick, 0.12, 0.3)
    go(place, 0.12, 0.3)
    go(place, 0.0, 0.1)
    time.sleep(1.0)
    return said


def test_ur_picks_and_places(ur5e: dict) -> None:
    begin(ur5e, 'reset 7 {"object": "wooden_block", "mass": 0.1}')
    layout = ask(ur5e["faults"], "truth")["layout"]
    height = max(layout["object"][2], 0.0185)
    pick, place = [*layout["object"][:2], height], [*layout["goal"], height]
    said = client(
        places, ur5e["address"], ur5e["gripper"]["port"], pick, place, yaw_of(layout["object"])
    )
    assert said == {"air": 3, "object": 2}
    truth = ask(ur5e["faults"], "truth")
    assert truth["success"] and truth["progress"] == 1


# Pictures and serial devices.


def test_pictures_come_freeze_and_stop(fr3: dict) -> None:
    name = "tactile_left"
    url = fr3["images"][f"observation.images.{name}"]
    capture = cv2.VideoCapture(url)
    frames = [capture.read()[1] for _ in range(3)]
    assert frames[0].shape == (240, 320, 3) and not np.array_equal(frames[1], frames[2])
    ask(fr3["faults"], f"repeat {name} 60")
    frames = [capture.read()[1] for _ in range(4)]
    np.testing.assert_array_equal(frames[2], frames[3])
    ask(fr3["faults"], f"repeat {name} 0")
    ask(fr3["faults"], f"lose {name} 60")
    while capture.read()[0]:
        pass
    assert not cv2.VideoCapture(url).isOpened()
    ask(fr3["faults"], f"lose {name} 0")
    assert cv2.VideoCapture(url).read()[0]
    front = cv2.VideoCapture(fr3["images"]["observation.images.front"]).read()[1]
    assert front.shape == (128, 128, 3) and front.std() > 10


def test_load_cell_weighs_is_garbled_and_unplugged(fr3: dict) -> None:
    begin(fr3, 'reset 3 {"object": "wooden_block", "mass": 0.1}')
    port = fr3["load_cell"]["port"]

    def readings(n: int) -> list[float | None]:
        device.reset_input_buffer()
        device.readline()
        found = []
        for _ in range(n):
            body, _, check = device.readline().strip().rpartition(b"*")
            good = check == b"%02X" % int(np.bitwise_xor.reduce(bytearray(body or b"\0")))
            value = body.split(b",")[1] if good else b""
            found.append(NEWTONS_PER_COUNT * (int(value) - ZERO) if good else None)
        return found

    with serial.Serial(port, 115200, timeout=2) as device:
        weights = [reading for reading in readings(20) if reading is not None]
        assert len(weights) == 20 and abs(np.median(weights) - 0.981) < 0.02
        ask(fr3["faults"], "garble load_cell 0.5")
        assert 3 < readings(20).count(None) < 18
        ask(fr3["faults"], "garble load_cell 0")
        ask(fr3["faults"], "unplug load_cell")
        with pytest.raises(serial.SerialException):
            for _ in range(100):
                device.readline()
    ask(fr3["faults"], "plug load_cell")
    with serial.Serial(port, 115200, timeout=2) as device:
        assert None not in readings(5)


def test_mistakes_say_what_to_do(fr3: dict) -> None:
    with pytest.raises(UserError, match="unknown command 'frieze'; there are: truth"):
        ask(fr3["faults"], "frieze 1")
    with pytest.raises(UserError, match="unknown object 'teapot'"):
        ask(fr3["faults"], 'reset 0 {"object": "teapot"}')
    with pytest.raises(UserError, match="no twin answers at 127.0.0.1:9"):
        ask("127.0.0.1:9", "truth")

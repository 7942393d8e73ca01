"""The twin over the wire: its controllers by their makers' clients, its load cell, its control port."""

import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from running_twin import RunningTwin, client

from touchgoal.control.cell.connection import connect_cell
from touchgoal.control.cell.twin_client import lease_twin
from touchgoal.control.sensors.load_cell import parse
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.twin.image_process import Stream
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig

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


def moves(address: str, home: list[float]) -> dict:
    """Full-speed moves; what the arm says to the limits of another arm, and to going too far."""
    import franky

    robot = connect(address)

    def refused(motion: "franky.JointMotion | franky.CartesianMotion") -> str:
        try:
            robot.move(motion)
        except (franky.ControlException, franky.CommandException) as error:
            robot.recover_from_errors()
            return str(error)
        return ""

    robot.joint_acceleration_limit.set([15.0, 7.5, 10, 12.5, 15, 20, 20])  # the Panda's
    panda = refused(franky.JointMotion((np.array(home) + 0.4).tolist()))
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
    before = np.array(robot.state.q)
    robot.move(franky.JointVelocityMotion([0.2, 0, 0, 0, 0, 0, 0], franky.Duration(300)))
    turned = np.array(robot.state.q) - before
    far = refused(franky.JointMotion([2.9, *home[1:]]))
    cartesian = refused(franky.CartesianMotion(franky.Affine([0, 0, 0.03])))
    refusals = {"panda": panda, "far": far, "cartesian": cartesian}
    return {"errors": errors, "turned": turned.tolist(), **refusals}


@pytest.mark.realtime
def test_franka_holds_clients_to_its_limits(fr3: RunningTwin) -> None:
    fr3.begin("reset 3")
    result = client(moves, fr3.cell.address, HOME, using=connect)
    assert "joint_motion_generator" in result["panda"] and "discontinuity" in result["panda"]
    assert "joint_motion_generator_" in result["far"] and "limits_violation" in result["far"]
    assert max(result["errors"]) < 2e-3
    assert "rejected" in result["cartesian"]
    assert 0.05 < result["turned"][0] < 0.07 and np.abs(result["turned"][1:]).max() < 3e-3
    worst = fr3.ask("truth")["worst"]
    assert worst["excess"] <= 0 and worst["speed"] < 1


def drives(address: str) -> dict:
    """Servoes at three rates, and falls silent."""
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)

    def at() -> np.ndarray:
        return np.array(receive.getActualQ())

    start = at()
    result: dict[str, Any] = {"servo": []}
    for rate in (20, 125, 500):
        began, worst, taken = time.monotonic(), 0.0, True
        while (now := time.monotonic() - began) < 0.8:
            goal = start.copy()
            goal[0] += 0.05 * np.sin(4 * now)  # ends where it begins
            taken &= control.servoJ(goal.tolist(), 0, 0, 1 / rate, 0.1, 300)
            worst = max(worst, abs(at()[0] - goal[0]))
            time.sleep(max(0.0, 1 / rate - (time.monotonic() - began - now)))
        control.servoStop()
        result["servo"].append([taken, worst])
    control.setWatchdog(10)
    for _ in range(10):
        control.kickWatchdog()
        time.sleep(0.03)
    result["kicked"] = control.isProgramRunning()
    time.sleep(1.0)
    result["silent"] = control.isProgramRunning()
    return result


@pytest.mark.realtime
def test_ur_servoes_and_watches(ur5e: RunningTwin) -> None:
    result = client(drives, ur5e.cell.address)
    for taken, worst in result["servo"]:
        assert taken and worst < 0.1  # rad behind a goal at 0.2 rad/s, on a loaded machine
    assert result["kicked"] and not result["silent"]
    assert ur5e.ask("truth")["worst"]["excess"] <= 0


def test_load_cell_weighs_is_garbled_and_unplugged(fr3: RunningTwin) -> None:
    fr3.begin('reset 3 {"object": "wooden_block", "mass": 0.1}')
    config = fr3.cell.load_cell
    assert config is not None

    def readings(n: int) -> list[float | None]:
        device.reset_input_buffer()
        device.readline()
        samples = [parse(device.readline().strip(), config) for _ in range(n)]
        return [sample.force if sample else None for sample in samples]

    with serial.Serial(config.port, 115200, timeout=2) as device:
        weights = [reading for reading in readings(20) if reading is not None]
        assert len(weights) == 20 and abs(np.median(weights) - 0.981) < 0.02
        fr3.ask("garble load_cell 0.5")
        assert 3 < readings(20).count(None) < 18
        fr3.ask("garble load_cell 0")
        fr3.ask("unplug load_cell")
        with pytest.raises(serial.SerialException):
            for _ in range(100):
                device.readline()
    fr3.ask("plug load_cell")
    with serial.Serial(config.port, 115200, timeout=2) as device:
        assert None not in readings(5)


def test_one_deployment_at_a_time_uses_a_twin(fr3: RunningTwin) -> None:
    fr3.begin("reset 5")
    with lease_twin(fr3.cell.task.twin):
        before = fr3.ask("truth")["layout"]["goal"]
        with pytest.raises(UserError, match="another deploy uses this twin"):
            connect_cell(fr3.cell)  # of another seed: it would put the scene back
        assert fr3.ask("truth")["layout"]["goal"] == before
    lease_twin(fr3.cell.task.twin).close()


def test_a_twin_ends_with_what_started_it_and_says_its_pace(tmp_path: Path) -> None:
    arguments = f"--port 0 --host 127.77.{os.getpid() % 250}.1 --env.no-tactile --env.cameras"
    twin = f"{sys.executable} -m touchgoal.launch twin {arguments} --out {tmp_path}"
    wait = f"until [ -e {tmp_path}/cell.json ]; do sleep 0.1; done"
    log = tmp_path / "log"
    # also where the tests run by nohup
    hears = partial(signal.signal, signal.SIGHUP, signal.SIG_DFL)
    command = ["sh", "-c", f"{twin} >{log} 2>&1 </dev/null & {wait}"]
    subprocess.run(command, check=True, timeout=120, preexec_fn=hears)
    deadline = time.monotonic() + 30
    while not log.read_text().endswith("no pace to report\nstopped\n"):
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.1)
    assert (tmp_path / "metrics.json").exists()


def test_a_host_of_no_interface_is_told() -> None:
    blind = PickPlaceConfig(tactile=False, cameras=())
    with pytest.raises(
        UserError, match="203.0.113.7 .Cannot assign.*: give an address of this comp"
    ):
        Twin(TwinConfig(blind, "fr3", 3, "203.0.113.7", 0, False, Path("/tmp")))


def test_web_pages_and_nonsense_change_nothing_at_the_control_port(fr3: RunningTwin) -> None:
    token, _, where = fr3.cell.task.twin.rpartition("@")
    host, _, number = where.rpartition(":")
    for stranger in ("kill", "x kill", f"{token[:-1]} kill"):
        with socket.create_connection((host, int(number)), timeout=5) as other:
            other.sendall(f"{stranger}\n".encode())
            assert b"token" in other.recv(100) and other.recv(100) == b""
    with socket.create_connection((host, int(number)), timeout=5) as page:
        body = f"stop-button on\n{token} nudge 0 400 0 5\n{token} kill\n"
        page.sendall(
            f"POST / HTTP/1.1\r\nHost: {where}\r\nOrigin: http://a.example\r\n"
            f"Content-Type: text/plain\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()
        )
        assert page.recv(100) == b""
    rng = np.random.default_rng(1)
    numbers = "nudge nan 0 0 1|nudge 1e308 0 0 1|freeze inf|reset -1|reset 99999999999999999999999"
    words = "stall front", "truth\x00", "reset 1 " + "[" * 100_000, "error " + "x" * 1000
    noise = (rng.bytes(40).decode("latin-1").replace("\n", "") for _ in range(50))
    for line in (*numbers.split("|"), *words, *noise):
        with pytest.raises(UserError):
            fr3.ask(line)
    truth = fr3.ask("truth")
    assert np.isfinite(truth["q"]).all() and truth["rest"] > 0


def test_streams_that_have_sent_as_many_images_are_told_apart() -> None:
    """Comparing streams by value ended the rendering process."""
    streams = [Stream(clients=1) for _ in range(2)]
    for stream in streams:
        stream.publish(np.zeros((4, 4, 3), np.uint8))
    assert streams[1] in streams and streams[1] not in streams[:1]

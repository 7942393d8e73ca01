"""The twin's cell without a wire; its pictures, its serial devices, and what it says to mistakes."""

import socket
from typing import Literal

import mujoco
import numpy as np
import pytest
import serial
from running_twin import RunningTwin

from touchgoal.control.sensors.load_cell import parse
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.cell.simulated_cell import SimulatedCell
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.twin.mjpeg import Stream


@pytest.mark.parametrize("arm", ["fr3", "ur5e"])
def test_arm_follows_without_lag(arm: Literal["fr3", "ur5e"]) -> None:
    cell = SimulatedCell(PickPlace(PickPlaceConfig(cameras=(), tactile=False, arm=arm)), 3)
    start, error = cell.q_d.copy(), 0.0
    for _ in range(1500):
        phase = 4 * (cell.time + 1e-3)  # 0.8 rad/s and 3.2 rad/s^2 at most
        cell.set_target(start + 0.2 * (1 - np.cos(phase)), np.full(len(start), 0.8 * np.sin(phase)))
        cell.step()
        error = max(error, float(np.abs(cell.q - cell.q_d).max()))
    assert error < 5e-3  # 0.08 rad without feed-forward
    cell.brake(np.full(len(start), 10.0))
    for _ in range(300):
        cell.step()
    assert not cell.moving and cell.worst.excess <= 0


@pytest.mark.parametrize("arm", ["fr3", "ur5e"])
def test_compiled_arm_agrees_with_mujoco(arm: Literal["fr3", "ur5e"]) -> None:
    env = PickPlace(PickPlaceConfig(cameras=(), tactile=False, arm=arm))
    cell, rng = SimulatedCell(env, 3), np.random.default_rng(0)
    for _ in range(20):
        q, offset = rng.uniform(-3, 3, env.n_joints), rng.normal(0.0, 0.1, 3)
        env.data.qpos[env.arm_positions] = q
        mujoco.mj_forward(env.model, env.data)
        site = env.data.site("tcp")
        R = site.xmat.reshape(3, 3)
        p, J = site.xpos + R @ offset, np.zeros((6, env.model.nv))
        mujoco.mj_jac(env.model, env.data, J[:3], J[3:], p, env.model.site_bodyid[site.id])
        expected = p, R, J[:, env.arm_dofs]
        for mine, theirs in zip(cell.kinematics(q, offset), expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12)


def test_fixture_waits_for_the_first_grasp() -> None:
    maze = BeadMazeConfig(split="validation", n_wires=20, tactile=False)
    cell = SimulatedCell(BeadMaze(maze), 3)
    for _ in range(2000):
        cell.step()
    fixture = cell.env.model.equality("fixture").id
    assert cell.env.data.eq_active[fixture]
    cell.command_gripper(0.0, 0.1, 10.0)
    for _ in range(1000):
        cell.step()
    assert not cell.env.data.eq_active[fixture] and not cell.failures
    np.testing.assert_allclose(cell.truth()["pad_forces"], 10.0, rtol=0.05)


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


def test_streams_that_have_sent_as_many_pictures_are_told_apart() -> None:
    """Comparing streams by value ended the rendering process."""
    streams = [Stream(clients=1) for _ in range(2)]
    for stream in streams:
        stream.publish(np.zeros((4, 4, 3), np.uint8))
    assert streams[1] in streams and streams[1] not in streams[:1]

"""The twin survives its clients: random and malformed packets on every port, then a client works on it.

TOUCHGOAL_FUZZ_PACKETS scales it (default 6,000 on each arm's protocol; a million before a release).
"""

import os
import resource
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running_twin import client

from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.twin.franka import messages as fci
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig
from touchgoal.sim_envs.twin.ur import messages as rtde

pytestmark = pytest.mark.realtime

PACKETS = int(os.environ.get("TOUCHGOAL_FUZZ_PACKETS", "6000"))
AT_ONCE = 20  # packets between two milliseconds
MAY_GROW = 20e6  # bytes


class Fuzzer:
    """A client that reconnects whenever it is dropped."""

    def __init__(self, host: str, port: int, hello: bytes, packet: Callable[[], bytes]) -> None:
        self._at, self._hello, self._packet = (host, port), hello, packet
        self._socket: socket.socket | None = None

    def send(self) -> None:
        try:
            if self._socket is None:
                self._socket = socket.create_connection(self._at, timeout=0.2)
                self._socket.setblocking(False)
                self._socket.send(self._hello)
            self._socket.send(self._packet())
            while self._socket.recv(65536):
                pass
            raise OSError  # the twin has hung up
        except BlockingIOError:
            pass
        except OSError:
            self.close()

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None


@pytest.fixture(params=["fr3", "ur5e"])
def twin(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Twin]:
    task = PickPlaceConfig(cameras=(), tactile=False, objects=("wooden_block",))
    n = ("fr3", "ur5e").index(request.param)
    host = f"127.{40 + n}.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    made = Twin(TwinConfig(task, request.param, 3, host, 0, False, tmp_path))
    yield made
    made.close()


def doubles(rng: np.random.Generator, n: int, order: str) -> bytes:
    kinds = rng.choice([0.0, 1e-3, 1.0, -1.0, 1e300, np.nan, np.inf, 7.0], n)
    return struct.pack(f"{order}{n}d", *(kinds * rng.normal(1, 0.1, n)))


def franka_fuzzers(twin: Twin, rng: np.random.Generator) -> list[Callable[[], None]]:
    host = twin.cell_config.address
    sizes = [0, 4, 8, 16, 32, 40, 56, 104, 128, 320, 416]

    def command(wide: bool) -> bytes:
        header, most = ("<III", 12) if wide else ("<HII", 5)
        kind, size = int(rng.integers(most)), int(rng.choice(sizes))
        payload = doubles(rng, size // 8, "<")
        if wide and kind == 1 and rng.random() < 0.8:  # a move that can be begun
            payload = struct.pack("<II6d", *rng.integers(0, 5, 2), *[1.0] * 6)
        length = struct.calcsize(header) + len(payload)
        if rng.random() < 0.1:
            length = int(rng.integers(0, 2**32))
        if rng.random() < 0.05:
            return rng.bytes(int(rng.integers(1, 60)))
        return struct.pack(header, kind, int(rng.integers(100)), length) + payload

    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    arm: Any = next(s for s in twin._services if type(s).__name__ == "FrankaArm")
    port = arm.link._udp.getsockname()[1]

    def order() -> None:
        made = np.zeros((), fci.ROBOT_ORDER)
        raw = bytearray(doubles(rng, -(-made.itemsize // 8), "<")[: made.itemsize])
        raw[:8] = struct.pack(
            "<Q", int(rng.choice([arm._sent - 1, arm._sent + 5, 2**64 - 1])) & 2**64 - 1
        )
        made = np.frombuffer(bytes(raw), fci.ROBOT_ORDER)[0]
        udp.sendto(rng.bytes(50) if rng.random() < 0.1 else made.tobytes(), (host, port))

    hello_arm = struct.pack("<IIIHH", 0, 1, 16, fci.ROBOT_VERSION, 9)
    hello_hand = struct.pack("<HIIHH", 0, 1, 14, fci.HAND_VERSION, 9)
    return [
        Fuzzer(host, fci.ROBOT_PORT, hello_arm, lambda: command(True)).send,
        Fuzzer(host, fci.HAND_PORT, hello_hand, lambda: command(False)).send,
        order,
    ]


def ur_fuzzers(twin: Twin, rng: np.random.Generator) -> list[Callable[[], None]]:
    host, kinds = twin.cell_config.address, [int(k) for k in rtde.Package] + [1, 255]
    registers = [f"input_double_register_{i}" for i in range(18)]
    names = ",".join(["input_int_register_0", "input_int_register_1", *registers])
    recipe = rtde.package(rtde.Package.INPUTS, names.encode())
    outputs = rtde.package(
        rtde.Package.OUTPUTS, struct.pack(">d", 500.0) + b"actual_q,actual_TCP_force"
    )

    def package() -> bytes:
        chance = rng.random()
        if chance < 0.7:  # a command with wild numbers
            body = struct.pack(">Bii", 1, *(int(n) for n in rng.integers(0, 75, 2)))
            return rtde.package(rtde.Package.DATA, body + doubles(rng, 18, ">"))
        if chance < 0.9:
            body = rng.bytes(int(rng.integers(0, 80)))
            return struct.pack(">HB", 3 + len(body), int(rng.choice(kinds))) + body
        return rng.bytes(int(rng.integers(1, 40)))

    def text() -> bytes:
        lines = [b"unlock protective stop\n", b"power on\n", b"brake release\n", rng.bytes(30)]
        return lines[int(rng.integers(4))]

    def script() -> bytes:
        return b"def rtde_control():\nend\n" if rng.random() < 0.7 else rng.bytes(200)

    rtde_client = Fuzzer(host, rtde.RTDE, recipe + outputs, package)
    return [
        *[rtde_client.send] * 8,
        Fuzzer(host, rtde.DASHBOARD, b"", text).send,
        Fuzzer(host, rtde.SCRIPT, b"", script).send,
    ]


def grown() -> float:
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def test_random_packets_neither_end_the_twin_nor_make_it_grow(twin: Twin) -> None:
    rng, cell = np.random.default_rng(0), twin.cell
    fr3 = twin.cell_config.arm == "fr3"
    fuzzers = (franka_fuzzers if fr3 else ur_fuzzers)(twin, rng)
    pace, twin._keep_pace = twin._keep_pace, lambda: None
    for _ in range(200):  # what is loaded at the first use is no growth
        fuzzers[int(rng.integers(len(fuzzers)))]()
        twin.step()
    before, arm = grown(), next(s for s in twin._services if hasattr(s, "clear_error"))
    for i in range(PACKETS // AT_ONCE):
        for _ in range(AT_ONCE):
            fuzzers[int(rng.integers(len(fuzzers)))]()
        twin.step()
        if i % 50 == 0:
            arm.clear_error()  # pyright: ignore
            if not fr3:
                arm.stop_button(False)  # pyright: ignore
    assert np.isfinite(cell.q).all() and not any(w.number for w in cell.env.data.warning)
    assert cell.worst.excess <= 0.01 and grown() - before < MAY_GROW
    for fuzzer in fuzzers:
        if isinstance(owner := getattr(fuzzer, "__self__", None), Fuzzer):
            owner.close()
    for _ in range(5000):
        twin.step()
    arm.clear_error()  # pyright: ignore
    cell.reset(3)
    twin._keep_pace = pace
    thread = threading.Thread(target=twin.run)
    thread.start()
    try:
        if not fr3:
            order = socket.create_connection((twin.cell_config.address, rtde.DASHBOARD))
            for line in (b"power on\n", b"brake release\n"):
                order.sendall(line)
                time.sleep(0.2)
            order.close()
        moved = client(moves_fr3 if fr3 else moves_ur, twin.cell_config.address)["moved"]
        assert abs(moved - 0.1) < 0.02
    finally:
        twin.stopped = True
        thread.join()


def moves_fr3(address: str) -> dict:
    import franky

    robot = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
    robot.recover_from_errors()
    robot.relative_dynamics_factor = 0.05
    before = np.array(robot.state.q)
    robot.move(franky.JointMotion((before + 0.1).tolist()))
    time.sleep(0.5)
    return {"moved": float((np.array(robot.state.q) - before).mean())}


def moves_ur(address: str) -> dict:
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive, control = RTDEReceiveInterface(address), RTDEControlInterface(address)
    before = np.array(receive.getActualQ())
    control.moveJ((before + 0.1).tolist(), 0.5, 1.0)
    time.sleep(0.5)
    return {"moved": float((np.array(receive.getActualQ()) - before).mean())}


def test_web_pages_and_nonsense_change_nothing_at_the_control_port(twin: Twin) -> None:
    port = twin.cell_config.task.twin
    thread = threading.Thread(target=twin.run)
    thread.start()
    try:
        token, _, where = port.rpartition("@")
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
        for line in (
            "nudge nan 0 0 1",
            "nudge 1e308 0 0 1",
            "freeze nan",
            "freeze inf",
            "reset -1",
            "reset 1 " + "[" * 100_000,
            "reset 99999999999999999999999",
            "stall front",
            "error " + "x" * 1000,
            "truth\x00",
            *(rng.bytes(40).decode("latin-1").replace("\n", "") for _ in range(50)),
        ):
            with pytest.raises(UserError):
                ask_twin(port, line)
        truth = ask_twin(port, "truth")
        assert np.isfinite(truth["q"]).all() and truth["rest"] > 0
    finally:
        twin.stopped = True
        thread.join()

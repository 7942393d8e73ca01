"""The twin survives its clients: random and malformed packets on every port, then a client works on it.

TOUCHGOAL_FUZZ_PACKETS scales it (default 6,000 on each arm's protocol; a million before a release).
"""

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.twin.serve import Twin, TwinConfig

pytestmark = pytest.mark.realtime


@pytest.fixture(params=["fr3", "ur5e"])
def twin(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Twin]:
    task = PickPlaceConfig(cameras=(), tactile=False, objects=("wooden_block",))
    n = ("fr3", "ur5e").index(request.param)
    host = f"127.{40 + n}.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    made = Twin(TwinConfig(task, request.param, 3, host, 0, False, tmp_path))
    yield made
    made.close()


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

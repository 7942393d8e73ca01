"""Client of a twin's control port (`token@host:port`); orders: `sim_envs/twin/control_port.py`."""

import json
import socket
import time
from typing import Any

from touchgoal.runtime.errors import UserError

_TIMEOUT = 60.0  # s for an answer, on a machine however loaded
_REST_TIMEOUT, _POLL_INTERVAL = 10.0, 0.1  # s for the arm of the run before to come to rest


def connect_control_port(address: str) -> socket.socket:
    """Connect to a twin's control port; UserError if no twin answers there."""
    host, _, port = address.rpartition("@")[2].rpartition(":")
    try:
        return socket.create_connection((host, int(port)), _TIMEOUT)
    except (OSError, ValueError) as error:
        raise UserError(
            f"no twin answers at {address or 'task.twin'}; start one: touchgoal twin"
        ) from error


def ask_twin(address: str, line: str) -> dict[str, Any]:
    """Send one line to a twin's control port and return the answer.

    Raises:
        UserError: the twin refuses, or has ended.
    """
    token, _, where = address.rpartition("@")
    try:
        with connect_control_port(address) as connection:
            connection.sendall(f"{token} {line}\n".encode())
            answer = json.loads(connection.makefile().readline())
    except (OSError, json.JSONDecodeError) as error:
        raise UserError(f"no twin answers at {where}; start one: touchgoal twin") from error
    if "error" in answer:
        raise UserError(answer["error"])
    return answer


def put_scene_back(address: str, seed: int) -> None:
    """Make a twin begin the episode of a seed, once its arm rests: arm, open hand and objects.

    Raises:
        UserError: the arm keeps moving, another program drives it, or there is no twin.
    """
    end = time.monotonic() + _REST_TIMEOUT
    while ask_twin(address, "truth")["rest"] == 0 and time.monotonic() < end:
        time.sleep(_POLL_INTERVAL)
    ask_twin(address, f"reset {seed}")

"""Control port of the twin: commands that reset the scene, inject faults and return the truth.

    truth                           ground truth, and the state of arm and gripper
    lease                           take the twin until this connection closes; refused if taken
    reset SEED [OPTIONS]            reset scene, arm and hand to an episode's start, clear errors;
                                    OPTIONS: the task's reset options as a JSON object
    hold                            stop a lock-step twin's time until this connection closes
    advance STEPS DRIVEN COMMANDS   advance it by STEPS ms, once a client drives the arm (DRIVEN 1)
                                    and the hand has received COMMANDS commands since `hold`
    pictures                        number of images sent on each stream, once all due ones are
    freeze SECONDS                  block arm and hand from their clients, for simulated SECONDS
    drop                            close the arm's connections
    stop-button on|off              user stop of a Franka, emergency stop of a UR
    error NAME                      stop the arm with an error, such as cartesian_reflex
    nonsense on|off                 report NaN as joint speeds
    nudge FX FY FZ SECONDS          push the hand, N in the base frame
    take-object                     remove the object of pick-and-place
    silence-gripper on|off          block a Franka Hand's link
    jam-gripper WIDTH               jam the fingers at WIDTH (m), until the next reset
    stall|repeat|lose NAME SECONDS  stream: no image, one image, closed connections
    break|halve NAME SECONDS        stream: JPEGs with wrong bytes, or cut in half
    garble NAME SHARE               serial port: messages lose bytes
    unplug|plug NAME                serial port
    kill                            end the twin's process at once, as kill -9 does

A line begins with the twin's token and a space; the cell file has it before the port's address
(`token@host:port`). Every answer is one line of JSON, an error {"error": ...}. A client without the
token, or a browser, is disconnected at its first line: no web page may break a twin.

From a shell: python -m touchgoal.sim_envs.twin.control_port runs/twin/cell.json stop-button on
"""

import json
import os
import re
import secrets
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.twin_client import ask_twin
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell
from touchgoal.sim_envs.twin.franka.controller import FrankaArm
from touchgoal.sim_envs.twin.images import Images
from touchgoal.sim_envs.twin.lock_step import LockStep
from touchgoal.sim_envs.twin.serial.devices import SerialPort
from touchgoal.sim_envs.twin.tcp_ports import ClientConnection, ListeningPort, Service
from touchgoal.sim_envs.twin.ur.controller import UrController

_HTTP = re.compile(r" HTTP/\d")  # end of a browser's first line
# Faults of a stream by order: attributes of `image_process.Stream`.
_STREAM_FAULTS = {"stall": "stalled", "repeat": "frozen", "lose": "lost"}
_STREAM_FAULTS |= {"break": "broken", "halve": "halved"}
_SWITCH = {"on": True, "off": False}
_STRONGEST_NUDGE = 500.0  # N


class ControlPort(Service):
    """Serves the commands above at a port of its own."""

    def __init__(
        self,
        cell: SimulatedCell,
        arm: FrankaArm | UrController,
        images: Images,
        ports: dict[str, SerialPort],
        host: str,
        port: int,
        lock_step: LockStep | None,
        on_reset: Callable[[], None],
    ) -> None:
        self._lock_step, self._on_reset = lock_step, on_reset
        self._cell, self._arm, self._images, self._ports = cell, arm, images, ports
        self._listener = ListeningPort(host, port)
        self._lessee: ClientConnection | None = None  # the deployment that uses the twin
        self._frozen_seconds = 0.0  # s, simulated: else a slow machine would end it too soon
        self._token = secrets.token_hex(8)
        self.address = f"{self._token}@{host}:{self._listener.port}"

    def receive(self) -> None:
        """Execute commands that have arrived."""
        if self._frozen_seconds > 0:
            self._frozen_seconds -= DT
            if self._frozen_seconds <= 0:
                self._arm.freeze(False)
        self.hold()

    def hold(self) -> None:
        """Execute commands that have arrived, without advancing the time of a freeze."""
        for client in self._listener.poll():
            for line in client.lines():
                if _HTTP.search(line):
                    client.close()  # a web page in a browser: ignore the rest that it sends
                    break
                token, _, order = line.partition(" ")
                if not secrets.compare_digest(token.encode(), self._token.encode()):
                    client.send(
                        b'{"error": "the twin\'s token is missing: its cell file has it"}\n'
                    )
                    client.close()
                    break
                answer = self._answer(order, client)
                if answer is not None:
                    client.send(json.dumps(answer).encode() + b"\n")

    @property
    def sockets(self) -> list[ListeningPort | ClientConnection]:
        """Sockets on which a command may arrive."""
        return [self._listener, *(client for client in self._listener.clients if client.open)]

    def close(self) -> None:
        """Free the port."""
        self._listener.close()

    def _answer(self, line: str, client: ClientConnection) -> dict[str, Any] | None:
        """Return the answer; None if it comes later."""
        command, _, rest = line.partition(" ")
        actions = {
            "truth": self._cell.truth,
            "lease": lambda: self._lease(client),
            "hold": lambda: self._held_time().hold(client),
            "advance": None,
            "pictures": None,
            "reset": lambda: self._reset(*rest.split(" ", 1)),
            "freeze": lambda: self._freeze(*_finite(rest)),
            "drop": self._arm.drop,
            "stop-button": lambda: self._arm.stop_button(_SWITCH[rest]),
            "error": lambda: self._arm.abort(rest),
            "nudge": lambda: self._nudge(*_finite(rest)),
            **dict.fromkeys(_STREAM_FAULTS, lambda: self._fault_stream(command, *rest.split())),
            "silence-gripper": lambda: self._arm.silence_gripper(_SWITCH[rest]),
            "jam-gripper": lambda: setattr(self._cell, "least_width", *_finite(rest)),
            "take-object": self._cell.take_object,
            "nonsense": lambda: setattr(self._arm, "nonsense", _SWITCH[rest]),
            "garble": lambda: self._garble(*rest.split()),
            "unplug": lambda: self._ports[rest].unplug(),
            "plug": lambda: self._ports[rest].plug(),
            "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
        }
        if command not in actions:
            return {"error": f"unknown command {command!r}; there are: {', '.join(actions)}"}
        try:
            if command == "advance":
                steps, driven, commands = (int(number) for number in rest.split())
                self._held_time().advance(client, steps, bool(driven), commands)
                return None
            if command == "pictures":
                self._held_time().count_images(client)
                return None
            return actions[command]() or {"ok": True}
        except (UserError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            return {"error": f"{line[:200]!r} cannot be done: {error}"}

    def _held_time(self) -> LockStep:
        if self._lock_step is None:
            raise UserError("this twin is not in lock-step: start it with --lock-step")
        return self._lock_step

    def _lease(self, client: ClientConnection) -> None:
        if self._lessee is not None and self._lessee.open:
            raise UserError("another deploy uses this twin: end it, or start a second twin")
        self._lessee = client

    def _reset(self, seed: str, options: str = "{}") -> None:
        if self._cell.moving:
            raise UserError("the arm moves; stop it first")
        if self._arm.driven:
            raise UserError("another program drives the arm; end that first")
        number, chosen = int(seed), json.loads(options)
        if not 0 <= number < 2**63 or not isinstance(chosen, dict):
            raise UserError("a seed is a number from 0, options are a JSON object")
        self._cell.reset(number, chosen)
        self._arm.clear_error()
        self._on_reset()

    def _freeze(self, seconds: float) -> None:
        self._arm.freeze(True)
        self._frozen_seconds = seconds

    def _nudge(self, x: float, y: float, z: float, seconds: float) -> None:
        if max(abs(x), abs(y), abs(z)) > _STRONGEST_NUDGE:
            raise UserError(f"a nudge has at most {_STRONGEST_NUDGE:g} N")
        self._cell.nudge(np.array([x, y, z]), seconds)

    def _fault_stream(self, command: str, name: str, seconds: str) -> None:
        self._images.set_fault(name, _STREAM_FAULTS[command], float(seconds))

    def _garble(self, name: str, share: str) -> None:
        self._ports[name].garble = float(share)


def _finite(text: str) -> list[float]:
    numbers = [float(number) for number in text.split()]
    if not np.isfinite(numbers).all():
        raise UserError("numbers must be finite")
    return numbers


if __name__ == "__main__":
    try:
        port = read_cell_file(Path(sys.argv[1])).task.twin
        print(json.dumps(ask_twin(port, " ".join(sys.argv[2:]))))
    except (UserError, IndexError) as mistake:
        sys.exit(f"{mistake}; usage: control_port CELL_FILE ORDER")

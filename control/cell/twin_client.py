"""Client of a twin's control port (`token@host:port`); orders: `sim_envs/twin/control_port.py`."""

import json
import socket
import time
from collections import deque
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np

from touchgoal.control.arms.streaming import ArmProcess
from touchgoal.control.grippers.franka_hand import PERIOD, FrankaHand
from touchgoal.control.interfaces import Camera, DriverError
from touchgoal.control.sensors.load_cell import SerialLoadCell
from touchgoal.runtime.errors import UserError

_TIMEOUT = 60.0  # s for an answer, on a loaded machine, too
_REST_TIMEOUT, _POLL_INTERVAL = 10.0, 0.1  # s for the arm of the run before to come to rest
_DT = 1e-3  # s of a step of the twin
_STREAM_STEPS = 5  # steps between two commands of the arm's stream, `arms.franka.RATE`
_IMAGE_TIMEOUT = 2.0  # s for an image that was sent
_SETTLING = 0.3  # s without an image after which none is on its way
_HISTORY_LENGTH = 400  # times kept for the ages of readings


def connect_control_port(address: str) -> socket.socket:
    """Connect to a twin's control port; UserError if no twin answers there."""
    host, _, port = address.rpartition("@")[2].rpartition(":")
    try:
        return socket.create_connection((host, int(port)), _TIMEOUT)
    except (OSError, ValueError) as error:
        where = address or "task.twin"
        raise UserError(f"no twin answers at {where}; start one: touchgoal twin") from error


def ask_twin(address: str, line: str) -> dict[str, Any]:
    """Send a line to a twin's control port and return the answer; UserError if refused."""
    with connect_control_port(address) as connection:
        return _ask(connection, address, line)


def lease_twin(address: str) -> socket.socket:
    """Take a twin until the returned connection is closed; UserError if another deployment has it."""
    connection = connect_control_port(address)
    with ExitStack() as undo:
        undo.enter_context(connection)
        _ask(connection, address, "lease")
        undo.pop_all()
    return connection


def _ask(connection: socket.socket, address: str, line: str) -> dict[str, Any]:
    """Return the answer to a line; DriverError if none comes, UserError if it is refused."""
    token, _, where = address.rpartition("@")
    try:
        connection.sendall(f"{token} {line}\n".encode())
        with connection.makefile() as answers:
            answer = json.loads(answers.readline())
    except (OSError, json.JSONDecodeError) as error:
        raise DriverError(f"no twin answers at {where}; start one: touchgoal twin") from error
    if "error" in answer:
        raise UserError(answer["error"])
    return answer


def reset_scene(address: str, seed: int) -> None:
    """Once a twin's arm rests, put arm, hand and objects to the start of a seed's episode.

    UserError if the arm keeps moving, another program drives it, or there is no twin.
    """
    end = time.monotonic() + _REST_TIMEOUT
    while ask_twin(address, "truth")["rest"] == 0 and time.monotonic() < end:
        time.sleep(_POLL_INTERVAL)
    ask_twin(address, f"reset {seed}")


class LockStepClock:
    """Clock of a twin in lock-step: its time advances only while a deployment waits for it.

    So nothing depends on the machine's speed: the same seed and cell file give the same run. Arm and
    hand take part in every step, and time goes on only once every command, answer and image under
    way has arrived. libfranka's own 1 kHz loop takes part in every millisecond. Once a twin has ended,
    time goes on in real time, so that ages show it.
    """

    def __init__(
        self,
        address: str,
        arm: ArmProcess,
        gripper: FrankaHand,
        cameras: dict[str, Camera],
        load_cell: SerialLoadCell | None,
    ) -> None:
        """Stop the twin's time; UserError if none is at the address, or it is not in lock-step."""
        self._arm, self._gripper, self._cameras = arm, gripper, cameras
        self._load_cell = load_cell
        self._address, self._connection = address, connect_control_port(address)
        self._lost = self._driven = False
        self._issued = self._answered = 0
        answer = self._ask("hold")
        self._time = self._gripper_due = answer["time"]
        self._missed = self._missed_images(self._ask("pictures"))
        self._history = deque([(time.monotonic(), self._time)], maxlen=_HISTORY_LENGTH)

    def reset(self, seed: int) -> None:
        """Let the twin begin the episode of a seed, at time 0; UserError if it refuses."""
        self._ask(f"reset {seed}")
        self._time = self._gripper_due = 0.0
        self._history.clear()
        self._history.append((time.monotonic(), 0.0))
        self._arm.advance(0.0)  # the driver now follows this time, not libfranka's

    def go_on(self) -> None:
        """Let the arm's driver follow the twin's time from where it is."""
        self._arm.advance(self._time)

    def now(self) -> float:
        """See Clock."""
        return self._time

    def age(self, stamp: float) -> float:
        """See Clock."""
        return self._time - float(np.interp(stamp, *np.array(self._history).T))

    def wait(self, until: float) -> None:
        """See Clock."""
        last_load = -np.inf
        while (steps := round((until - self._time) / _DT)) > 0 and not self._lost:
            # An advance ends at the latest when the stream's next command is due.
            steps = min(steps, _STREAM_STEPS - round(self._time / _DT) % _STREAM_STEPS)
            answer = self._ask(f"advance {steps} {int(self._driven)} {self._issued}")
            if self._lost:
                break
            self._time, self._answered, last_load = (answer[k] for k in ("time", "hand", "load"))
            self._history.append((time.monotonic(), self._time))
            if not answer["frozen"]:
                self._let_drivers_tick()
        if self._lost:
            self._wait_without_twin(until)
        self._await_images({} if self._lost else self._ask("pictures"))
        self._await_load(last_load)

    def close(self) -> None:
        """Let the twin's time go on by itself."""
        self._connection.close()

    def _let_drivers_tick(self) -> None:
        self._driven = self._arm.advance(self._time)
        if self._time >= self._gripper_due - _DT / 2:
            self._gripper_due += PERIOD
            with suppress(DriverError):  # the next reading says so
                self._issued = self._gripper.advance(self._answered)

    def _wait_without_twin(self, until: float) -> None:
        while self._time < until:
            time.sleep(_STREAM_STEPS * _DT)
            self._time += _STREAM_STEPS * _DT
            self._history.append((time.monotonic(), self._time))
            self._arm.advance(self._time)

    def _missed_images(self, sent: dict[str, int]) -> dict[str, int]:
        """Return the number of sent images that each camera has missed; DriverError for a broken one."""
        found: dict[str, int] | None = None
        while True:
            before, streams = found, self._streams(sent)
            found = {key: sent[name] - camera.read().sequence for key, name, camera in streams}
            if found == before:
                return found
            time.sleep(_SETTLING)

    def _streams(self, sent: dict[str, int]) -> list[tuple[str, str, Camera]]:
        """Return key, the twin's name and camera of each stream that is read here."""
        named = ((key, key.rpartition(".")[2], camera) for key, camera in self._cameras.items())
        return [(key, name, camera) for key, name, camera in named if name in sent]

    def _await_images(self, sent: dict[str, int]) -> None:
        """Wait for all images that the twin has sent, except lost ones."""
        end = time.monotonic() + _IMAGE_TIMEOUT
        for key, name, camera in self._streams(sent):
            with suppress(DriverError):
                while (missing := sent[name] - self._missed[key] - camera.read().sequence) > 0:
                    # the image is lost, as when a stream is opened again
                    if time.monotonic() > end:
                        self._missed[key] += missing
                        break
                    time.sleep(_DT / 2)

    def _await_load(self, sent: float) -> None:
        """Wait for the load cell's line of that time; a cell that loses lines is not waited for again."""
        end = time.monotonic() + _IMAGE_TIMEOUT
        while self._load_cell is not None and self._load_cell.clock < sent:
            if time.monotonic() > end:
                self._load_cell = None
            time.sleep(_DT / 2)

    def _ask(self, line: str) -> dict[str, Any]:
        try:
            return _ask(self._connection, self._address, line)
        except DriverError:
            self._lost = True
            return {}

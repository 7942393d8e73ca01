"""Images of the twin's cameras and fingertips: schedule and streams."""

import subprocess
import sys
import time
from multiprocessing.connection import Pipe

import mujoco
import numpy as np

from touchgoal.control import features as ft
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.simulated_cell import SimulatedCell
from touchgoal.sim_envs.twin.image_process import STATE, Fault, RenderRequest, Scene
from touchgoal.sim_envs.twin.tcp_ports import Service

CAMERA_RATE = 25  # Hz, as a fingertip's; more than a policy reads
_START_TIMEOUT, _END_TIMEOUT = 120.0, 5.0  # s, on a loaded machine, too
_MOST_BEHIND = 2  # unanswered requests in real time, beyond which images are left out
_PROGRAM = "from touchgoal.sim_envs.twin.image_process import main; main()"


class Images(Service):
    """Streams cameras and sensors of the cell at `http://host:port/NAME`, by `image_process`."""

    def __init__(self, cell: SimulatedCell, host: str, port: int) -> None:
        """Start the process; raises OSError if it cannot serve there."""
        self._cell, self._host = cell, host
        self.held = False  # whether a client holds the time, and waits for each image
        # taken, left_out: due images that were taken, or skipped because the process was behind
        self.taken = self.left_out = 0
        env = cell.env
        self.rates: dict[str, int] = {}  # Hz, simulated, by stream, such as tactile_left
        if env.config.tactile:  # fingertips first: images are sent in this order
            names = [key.removeprefix(ft.IMAGE_PREFIX) for key in ft.TACTILE]
            self.rates |= dict.fromkeys(names, round(env.sensor.frame_rate))
        self.rates |= dict.fromkeys(env.config.cameras, CAMERA_RATE)
        self._due = [
            tuple(name for name, rate in self.rates.items() if ms * rate % 1000 < rate)
            for ms in range(1000)
        ]
        # sent: number of images sent on each stream; processor_time: of the rendering process, s
        self.sent, self.processor_time = dict.fromkeys(self.rates, 0), 0.0
        self._unanswered = 0
        self._pipe, theirs = Pipe()
        self._process = subprocess.Popen(  # own session: Ctrl-C is for the twin, which ends it
            [sys.executable, "-c", _PROGRAM, str(theirs.fileno()), host, str(port), *self.rates],
            pass_fds=[theirs.fileno()],
            start_new_session=True,
        )
        theirs.close()
        self._port = self._await_port()
        self.reset()

    def addresses(self) -> dict[str, str]:
        """Return the address of each stream by its name."""
        return {name: f"http://{self._host}:{self._port}/{name}" for name in self.rates}

    def send(self) -> None:
        """Request the images that are due."""
        due = self._due[self._cell.steps % 1000]
        if due:
            env = self._cell.env
            env.update_contacts()  # watched or not: watching must not change the physics
            self._hear()
            if self._unanswered >= _MOST_BEHIND and not self.held:
                self.left_out += len(due)
                return
            state = np.empty(mujoco.mj_stateSize(env.model, STATE))
            mujoco.mj_getState(env.model, env.data, state, STATE)
            self._tell(RenderRequest(due, state, env.pad_contacts(), self.held))
            self._unanswered += 1
            self.taken += len(due)

    @property
    def all_sent(self) -> bool:
        """Whether all due images are sent."""
        self._hear()
        return not self._unanswered

    def fileno(self) -> int:
        """Return the descriptor on which answers arrive, for `select`."""
        return self._pipe.fileno()

    def set_fault(self, name: str, kind: str, seconds: float) -> None:
        """Make a stream stalled, frozen, lost, broken or halved; KeyError if there is none."""
        if name not in self.rates:
            raise KeyError(name)
        self._tell((name, kind, time.monotonic() + seconds))

    def reset(self) -> None:
        """Follow a new episode; the cameras' noise restarts."""
        env = self._cell.env
        self._tell(Scene(env.model, env.config.camera_size, env.pads, env.np_random))

    def close(self) -> None:
        """Close all streams and end the process."""
        self._pipe.close()
        try:
            self._process.wait(_END_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _await_port(self) -> int:
        try:
            answer = self._pipe.recv() if self._pipe.poll(_START_TIMEOUT) else None
        except EOFError:
            answer = None
        if isinstance(answer, int):
            return answer
        self.close()
        raise answer or UserError("the process for the twin's images did not start")

    def _tell(self, message: Scene | RenderRequest | Fault) -> None:
        try:
            self._pipe.send(message)
        except OSError as error:
            raise _ended() from error

    def _hear(self) -> None:
        """Take answers that have arrived."""
        try:
            while self._unanswered and self._pipe.poll():
                self.sent, self.processor_time = self._pipe.recv()
                self._unanswered -= 1
        except (OSError, EOFError) as error:
            raise _ended() from error


def _ended() -> UserError:
    return UserError("the process that renders the twin's images has ended; its messages are above")

"""The Franka Hand's service in front of the cell's gripper."""

import time
from dataclasses import dataclass

import numpy as np

from touchgoal.sim_envs.cell.hardware import GRIPPER_MAX_WIDTH, GRIPPER_SPEED
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell
from touchgoal.sim_envs.scene.build import GRIPPER_MAX_FORCE
from touchgoal.sim_envs.twin.franka import messages
from touchgoal.sim_envs.twin.franka.messages import HandCommand, HandStatus
from touchgoal.sim_envs.twin.tcp_ports import Service

_STILL = 1e-3  # m/s of width
_SETTLED = 0.1  # s without motion after which a move is over
_SOMETHING = 1e-3  # m: narrower than this the fingers have met
_STATE_INTERVAL = 20  # ms between states; a real hand takes 20 to 50
_FIRST_STATE = 5  # ms: then no state is on its way when a lock-step client looks, every 50 ms
_HELD_INTERVAL = 0.004  # s between states while time stands
_GRASP_TOLERANCE = 2e-3  # m by which the width may change while something is held


@dataclass
class Job:
    """Command in progress."""

    request: messages.Request  # answered when the job ends
    targets: list[float]  # widths (m) still to go to, one after the other
    accepted: tuple[float, float] | None = None  # of a grasp: open range of widths, m
    width: float = np.inf
    still: float = 0.0


class FrankaHand(Service):
    """Serves the hand at `host`, port 1338; a grasp closes until something resists."""

    def __init__(self, cell: SimulatedCell, host: str) -> None:
        self.cell = cell
        self.link = messages.Link(host, messages.HAND_PORT, messages.HAND_VERSION, wide=False)
        self.commands = self.answers = 0  # numbers of commands received and answered
        self._milliseconds = 0
        self._held_at = 0.0  # monotonic s, of the last state while time stands
        self._job: Job | None = None
        self._grasped, self._held = False, 0.0  # m, the width of what is held
        self._state = np.zeros((), messages.HAND_STATE)
        self._state["max_width"], self._state["temperature"] = GRIPPER_MAX_WIDTH, 30

    def receive(self) -> None:
        """Take commands; advance the one in progress."""
        for request in self.link.requests():
            self._handle(request)
        if self._job is not None:
            self._update_job(self._job)

    def send(self) -> None:
        """Send the state when it is due."""
        self._milliseconds += 1
        if self._grasped:
            self._grasped = abs(self.cell.env.width() - self._held) < _GRASP_TOLERANCE
        if self.cell.steps % _STATE_INTERVAL == _FIRST_STATE:
            self._write_state()
            self.link.send(self._state.tobytes())

    def hold(self) -> None:
        """Take commands while time stands, and send the present state."""
        for request in self.link.requests():
            self._handle(request)
        if time.monotonic() - self._held_at > _HELD_INTERVAL:
            self._held_at = time.monotonic()
            self.link.send(self._state.tobytes())

    def reset(self) -> None:
        """Abort the command in progress and forget the grasp."""
        self._grasped = False
        if self._job is not None:
            self.link.answer(self._job.request, HandStatus.ABORTED)  # its client is gone
        self._job = None
        self._write_state()

    def close(self) -> None:
        """Free the port."""
        self.link.close()

    def _handle(self, request: messages.Request) -> None:
        command, job, cell = request.command, self._job, self.cell
        if job is not None:
            self._job = None
            self._answer(job.request, HandStatus.ABORTED)
        self.commands += 1
        self._grasped = False
        moves = command in (HandCommand.MOVE, HandCommand.GRASP)
        numbers = np.frombuffer(request.payload, "<f8") if moves else np.zeros(0)
        if not np.isfinite(numbers).all() or (numbers[:2] < 0).any():
            self.link.answer(request, HandStatus.FAIL)
        elif command == HandCommand.STOP:
            cell.command_gripper(cell.env.width(), GRIPPER_SPEED, cell.gripper_command.force)
            self._answer(request, HandStatus.SUCCESS)
        elif command == HandCommand.HOMING:
            self._job = Job(request, [0.0, GRIPPER_MAX_WIDTH])
            cell.command_gripper(0.0, GRIPPER_SPEED / 2, GRIPPER_MAX_FORCE / 4)
        elif command == HandCommand.MOVE:
            width, speed = numbers
            self._job = Job(request, [width])
            cell.command_gripper(width, speed, GRIPPER_MAX_FORCE / 2)
        elif command == HandCommand.GRASP:
            # On the wire: width, then how much narrower and wider will do, then speed and force.
            width, inner, outer, speed, force = numbers
            self._job = Job(request, [0.0], (width - inner, width + outer))
            cell.command_gripper(0.0, speed, force)

    def _update_job(self, job: Job) -> None:
        width = self.cell.env.width()
        moved, job.width = abs(width - job.width), width
        job.still = job.still + DT if moved < _STILL * DT else 0.0
        if job.still < _SETTLED:
            return
        job.still = 0.0
        reached = job.targets.pop(0)
        if job.targets:
            self.cell.command_gripper(job.targets[0], GRIPPER_SPEED / 2, GRIPPER_MAX_FORCE / 4)
            return
        self._job = None
        status = HandStatus.SUCCESS
        if job.accepted is not None:
            least, most = job.accepted
            self._grasped, self._held = max(least, _SOMETHING) < width < most, width
            status = HandStatus.SUCCESS if self._grasped else HandStatus.UNSUCCESSFUL
        elif abs(width - reached) > 2e-3:
            status = HandStatus.UNSUCCESSFUL  # something was in the way
        self._answer(job.request, status)

    def _write_state(self) -> None:
        self._state["message_id"] = self._milliseconds
        self._state["width"] = max(0.0, self.cell.env.width())
        self._state["is_grasped"] = self._grasped

    def _answer(self, request: messages.Request, status: HandStatus) -> None:
        self.link.answer(request, status)
        self.answers += 1

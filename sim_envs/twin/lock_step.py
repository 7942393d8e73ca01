"""Time of a lock-step twin: a client that holds it advances it, a few milliseconds at a time."""

import json
import select
import time
from collections.abc import Sequence
from typing import Any

from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.simulated_cell import SimulatedCell
from touchgoal.sim_envs.twin.franka.controller import FrankaArm
from touchgoal.sim_envs.twin.franka.hand import FrankaHand
from touchgoal.sim_envs.twin.images import Images
from touchgoal.sim_envs.twin.serial.devices import LoadCell
from touchgoal.sim_envs.twin.tcp_ports import ClientConnection

_POLL_INTERVAL = 5e-3  # s between looks at the links while time stands and nothing comes
_MOST_STEPS = 1000  # at a time
_PATIENCE = 3.0  # s of wall time to wait for messages that the holder announced


class LockStep:
    """Time that advances only as its holder asks.

    Advancing begins once the arm's client drives it (if the holder says so) and the hand has
    received what was sent. It ends once the arm's client has answered the last state.
    """

    def __init__(
        self,
        cell: SimulatedCell,
        arm: FrankaArm,
        hand: FrankaHand,
        images: Images,
        load_cell: LoadCell,
    ) -> None:
        self._load_cell = load_cell
        self._cell, self._arm, self._hand, self._images = cell, arm, hand, images
        self._holder: ClientConnection | None = None
        self._left = 0  # steps asked for and not yet made
        self._driven, self._issued, self._until = False, 0, 0.0
        self._commands_before = self._answers_before = 0
        self._asked = self._asks_images = False  # whether the holder waits for an answer

    def hold(self, client: ClientConnection) -> dict[str, Any]:
        """Give the time to a client until it leaves; UserError if another holds it."""
        if self.held:
            raise UserError("another program holds the time of this twin")
        self._holder, self._left, self._asked, self._asks_images = client, 0, False, False
        self._commands_before, self._answers_before = self._hand.commands, self._hand.answers
        self._images.held = True
        return self._report()

    def advance(self, client: ClientConnection, steps: int, driven: bool, issued: int) -> None:
        """Advance by a number of steps; the answer follows when they are made."""
        self._check_holder(client)
        if not 0 < steps <= _MOST_STEPS:
            raise UserError(f"steps are a number from 1 to {_MOST_STEPS}")
        self._left, self._asked, self._until = steps, True, time.monotonic() + _PATIENCE
        self._driven, self._issued = driven, issued

    def count_images(self, client: ClientConnection) -> None:
        """Tell the holder how many images were sent, once all due ones are."""
        self._check_holder(client)
        self._asks_images = True

    @property
    def held(self) -> bool:
        """Whether a client holds the time."""
        self._images.held = self._holder is not None and self._holder.open
        return self._images.held

    @property
    def standing(self) -> bool:
        """Whether time stands now; answers the holder when its steps are made."""
        if not self.held:
            return False
        if self._left and self._ready():
            return False
        if self._asked and not self._left and (self._arm.answered or self._impatient):
            self._asked = False
            self._answer(self._report())
        if self._asks_images and self._images.all_sent:
            self._asks_images = False
            self._answer(self._images.sent)
        return True

    def count_step(self) -> None:
        """Count a step."""
        self._left -= self._left > 0

    def wait(self, sockets: Sequence[Any]) -> None:
        """Wait briefly for a message of the arm's or hand's client, or on these sockets."""
        links = [*self._arm.link.sockets, *self._hand.link.sockets]
        drawn = [self._images] if self._asks_images else []
        select.select([*links, *sockets, *drawn], [], [], _POLL_INTERVAL)

    def _check_holder(self, client: ClientConnection) -> None:
        if client is not self._holder:
            raise UserError("hold the time of this twin first")

    def _ready(self) -> bool:
        if self._arm.link.frozen or self._impatient:
            return True
        commanded = self._hand.commands - self._commands_before >= self._issued
        return commanded and self._arm.answered and (self._arm.follows_commands or not self._driven)

    @property
    def _impatient(self) -> bool:
        return time.monotonic() > self._until

    def _answer(self, answer: dict[str, Any]) -> None:
        assert self._holder is not None
        self._holder.send(json.dumps(answer).encode() + b"\n")

    def _report(self) -> dict[str, Any]:
        return {
            "time": self._cell.time,
            "hand": self._hand.answers - self._answers_before,
            "load": self._load_cell.sent,
            "frozen": self._arm.link.frozen,
        }

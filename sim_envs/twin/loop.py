"""The twin's one loop: everything on the wire and the physics, a millisecond at a time."""

import time
from typing import Protocol

from touchgoal.sim_envs.twin.cell import DT, Cell

_BACKLOG = 0.1  # s behind real time beyond which the twin stops trying to catch up


class Service(Protocol):
    """Something that clients talk to; never blocks."""

    def receive(self) -> None:
        """Before a physics step: take what clients have sent."""

    def send(self) -> None:
        """After it: answer them."""

    def close(self) -> None:
        """Free ports and files."""


class Twin:
    """The cell with its services, in one thread, so that runs repeat.

    In lock-step simulated time never runs faster than the clock, and waits for a client that
    drives the arm; in real time the cell catches up with the clock.
    """

    def __init__(self, cell: Cell, services: list[Service], lock_step: bool) -> None:
        self.cell, self.services, self._lock_step = cell, services, lock_step
        self._due = time.monotonic()
        self.stopped = False

    def run(self) -> None:
        """Serve until `stopped`."""
        while not self.stopped:
            self.step()

    def step(self) -> None:
        """One millisecond of everything."""
        for service in self.services:
            service.receive()
        self.cell.step()
        for service in self.services:
            service.send()
        self._keep_pace()

    def close(self) -> None:
        """Free ports, files and the OpenGL context."""
        for service in self.services:
            service.close()
        self.cell.env.close()

    def _keep_pace(self) -> None:
        now = time.monotonic()
        allowed = 0.0 if self._lock_step else _BACKLOG
        self._due = max(self._due + DT, now - allowed)
        if self._due > now:
            time.sleep(self._due - now)

"""Moves without a task: the arm to a posture, the hand open or closed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.cell.limits import cell_watchdogs
from touchgoal.control.deployment.control_loop import ControlLoop, Ending, Request, TickStatus
from touchgoal.control.deployment.scripted import PlannedMove, ScriptedActor, start_move
from touchgoal.control.interfaces import Joints
from touchgoal.control.run_log import RunLog
from touchgoal.control.safety.action_filter import ActionFilter

_TIMEOUT = 60.0  # s for a move
_STILL_SECONDS = 1.0  # s for which a hand must stand still to have arrived
_THERE = 1e-3  # rad; an arm this near a posture need not move to it


@dataclass(frozen=True)
class ManualControl:
    """One connection inside the cell's limits; the last two fields as for `ControlLoop`.

    A move that cannot begin raises UserError or DriverError, and nothing has moved then.
    """

    cell: CellConfig
    connection: CellConnection
    operator_request: Callable[[], Request]
    on_tick: Callable[[TickStatus], None]

    def move_arm(self, goal: Joints) -> Ending:
        """Move slowly and straight in joint space to a posture (rad), the hand keeping its width."""
        loop, safety = self._loop()
        if np.abs(goal - loop.commanded()).max() > _THERE:
            return loop.run(
                start_move(goal, loop.width, safety, loop.commanded), _TIMEOUT, RunLog()
            )
        return self._wait(loop, loop.width)  # a fault still shows

    def move_hand(self, opened: bool) -> Ending:
        """Open the hand, or close it until it meets an object or is closed."""
        loop, safety = self._loop()
        return self._wait(loop, safety.limits.tool.stroke[int(opened)])

    def _loop(self) -> tuple[ControlLoop, ActionFilter]:
        watchdogs = cell_watchdogs(self.cell)
        safety = ActionFilter(self.connection.robot, ft.CONTROL_HZ, watchdogs)
        loop = ControlLoop(self.connection, safety, True, self.operator_request, self.on_tick)
        return loop, safety

    def _wait(self, loop: ControlLoop, width: float) -> Ending:
        """Hold the arm until the hand stands still, at `width` (m) or at an object."""
        wait = PlannedMove(None, width, _STILL_SECONDS)
        return loop.run(ScriptedActor([wait], loop.commanded, ft.CONTROL_HZ), _TIMEOUT, RunLog())

"""Moves without a task: the arm to its start pose, the hand open or closed."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.cell.limits import cell_watchdogs
from touchgoal.control.deployment.control_loop import (
    ControlLoop,
    Ending,
    Request,
    RunLog,
    TickStatus,
)
from touchgoal.control.deployment.scripted import PlannedMove, ScriptedActor, start_move
from touchgoal.control.interfaces import Joints
from touchgoal.control.motion.arm_models import ArmModel
from touchgoal.control.safety.action_filter import ActionFilter

Move = Literal["home", "open", "close"]
_TIMEOUT = 60.0  # s for a move
_HAND_SECONDS = 1.0  # s for which a hand must stand still to have arrived


def arm_and_gripper(cell: CellConfig) -> CellConfig:
    """Return the cell without cameras and fingertips: a broken one must not keep the arm in place."""
    return replace(cell, cameras={}, fingertips=None)


def home_pose(cell: CellConfig, arm: ArmModel) -> Joints:
    """Return the cell's `task.start` (rad), else the arm model's home."""
    return arm.home if cell.task.start is None else np.array(cell.task.start)


def run_move(
    move: Move,
    cell: CellConfig,
    connection: CellConnection,
    operator_request: Callable[[], Request],
    on_tick: Callable[[TickStatus], None],
) -> Ending:
    """Run one move inside the cell's limits; `operator_request` and `on_tick` as for `ControlLoop`.

    The arm goes home slowly and straight in joint space, the hand keeping its width. UserError or
    DriverError if it cannot begin; nothing has moved then.
    """
    safety = ActionFilter(connection.robot, ft.CONTROL_HZ, cell_watchdogs(cell))
    loop = ControlLoop(connection, safety, True, operator_request, on_tick)
    if move == "home":
        goal = home_pose(cell, connection.robot.arm)
        actor = start_move(goal, loop.width, safety, loop.commanded)
    else:
        width = safety.limits.tool.stroke[1] if move == "open" else safety.limits.tool.stroke[0]
        wait = PlannedMove(None, width, _HAND_SECONDS)
        actor = ScriptedActor([wait], loop.commanded, ft.CONTROL_HZ)
    return loop.run(actor, _TIMEOUT, RunLog())

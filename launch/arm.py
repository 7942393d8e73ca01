"""Move an arm or its hand without a task, or recover the arm after a reflex or a stop.

With `home` it moves slowly to the cell file's task.start, by default to the arm's home; `open` lets go of what the
hand holds. Speed, workspace, force and torque are limited as in `deploy`; cameras and fingertips are
not read, so gels are not watched. Exit status: 0 done, 1 nothing moved, 4 the arm was stopped.
"""

import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from touchgoal.control.cell.config import CellConfig
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import checked_dataclass

_STOPPED = 4  # exit status


@checked_dataclass
class Config:
    """Options of arm."""

    action: Annotated[Literal["home", "open", "close", "recover"], tyro.conf.Positional]
    """Move the arm home, open or close the hand, or clear a fault whose cause is gone."""
    cell: Annotated[Path, tyro.conf.Positional]
    """Cell file of an arm, or the cell.json of a twin."""
    yes: bool = False
    """Do not ask for the typed confirmation (for tests)."""


def main(config: Config) -> None:
    """Connect, ask, act, report."""
    from touchgoal.control.cell.cell_file import find_cell_file, read_cell_file
    from touchgoal.control.deployment.preflight import check_client
    from touchgoal.launch.support.cell_run import confirm

    cell = read_cell_file(find_cell_file(config.cell))
    # A broken camera or fingertip must not keep the arm in place.
    cell = replace(cell, cameras={}, fingertips=None)
    if cell.arm == "sim":
        raise UserError(
            "a simulated arm ends with its command: give a real arm's cell file or a twin's"
        )
    check_client(cell)
    if not config.yes:
        confirm(cell)
    if config.action == "recover":
        _recover(cell)
    else:
        _move(config.action, cell)


def _recover(cell: CellConfig) -> None:
    from touchgoal.control.cell.connection import connect_arm

    with closing(connect_arm(cell, recover=True)) as arm:
        if fault := arm.read().fault:
            raise UserError(f"not recovered: {fault}")
    print("recovered: the arm takes commands")


def _move(move: str, cell: CellConfig) -> None:
    import numpy as np

    from touchgoal.control.deployment.control_loop import PLAN_ENDED
    from touchgoal.control.deployment.manual import ManualControl
    from touchgoal.control.deployment.terminal import HELP, Terminal
    from touchgoal.launch.support.cell_run import connect

    terminal = Terminal()
    with closing(connect(cell, new_episode=False)) as connection:
        with terminal.watching():
            print(f"MOVING: {HELP}", flush=True)
            control = ManualControl(cell, connection, terminal.operator_request, terminal.show_tick)
            if move == "home":
                start = cell.task.start
                home = connection.robot.arm.home if start is None else np.array(start)
                ending = control.move_arm(home)
            else:
                ending = control.move_hand(opened=move == "open")
        arm, hand = connection.arm.read(), connection.gripper.read()
    holds = ", it holds something" if hand.grasped else ""
    print(
        f"joints at {np.round(arm.q, 3).tolist()} rad, hand {1e3 * hand.width:.0f} mm wide{holds}"
    )
    if ending.stopped:
        print(f"touchgoal arm: {ending}", file=sys.stderr)
        sys.exit(_STOPPED)
    if ending.reason != PLAN_ENDED:
        raise UserError(f"{move} was not finished: {ending}")

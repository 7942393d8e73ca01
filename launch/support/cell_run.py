"""Steps that every command with a moving arm shares: connect, check and ask."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from touchgoal.control import features as ft
from touchgoal.runtime.errors import UserError, require_all_ok

if TYPE_CHECKING:
    from touchgoal.control.cell.config import CellConfig
    from touchgoal.control.cell.connection import CellConnection
    from touchgoal.control.safety.action_filter import ActionFilter


def connect(cell: "CellConfig", new_episode: bool = True) -> "CellConnection":
    """Connect to a cell or simulate it; see `connect_cell`."""
    from touchgoal.control.cell.connection import connect_cell

    if cell.arm == "sim":
        from touchgoal.sim_envs.cell.in_process import simulate_cell

        return simulate_cell(cell, ft.CONTROL_HZ)
    return connect_cell(cell, new_episode)


def check_cell(cell: "CellConfig", connection: "CellConnection", episodes: Path) -> "ActionFilter":
    """Print the checks before anything moves; return the safety layer, UserError if one fails.

    `episodes` is the folder that the run records into.
    """
    from touchgoal.control.cell.limits import cell_watchdogs
    from touchgoal.control.deployment.preflight import preflight
    from touchgoal.control.safety.action_filter import ActionFilter
    from touchgoal.episodes.store import EpisodeWriter

    safety = ActionFilter(connection.robot, ft.CONTROL_HZ, cell_watchdogs(cell))
    print("checks before anything moves:", flush=True)
    results = preflight(
        cell, connection, safety, episodes, lambda: len(EpisodeWriter(episodes, ft.CONTROL_HZ))
    )
    print("\n".join(map(str, results)), flush=True)
    require_all_ok(results)
    return safety


def confirm(cell: "CellConfig", connection: "CellConnection | None" = None) -> None:
    """UserError unless the operator types which arm is to move, or it is simulated.

    Of a connection each fingertip must first feel that the operator touches it.
    """
    from touchgoal.control.sensors.exchanged import probe_fingertips

    if cell.moves_nothing_real:
        return
    name = f"{cell.arm} {cell.address}".strip()
    if sys.stdin is None or not sys.stdin.isatty():
        raise UserError("nobody is there to confirm: run it in a terminal, or add --yes")
    tips = connection.fingertips if connection else {}
    probe_fingertips({key.rpartition("_")[2]: tip for key, tip in tips.items()})
    print(f"The arm will move. One hand on its stop, nobody in reach? Type: {name}")
    if input("> ").strip() != name:
        raise UserError("not confirmed; nothing has moved")

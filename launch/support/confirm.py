"""The question before an arm moves."""

import sys
from typing import TYPE_CHECKING

from touchgoal.runtime.errors import UserError

if TYPE_CHECKING:
    from touchgoal.control.cell.config import CellConfig
    from touchgoal.control.cell.connection import CellConnection


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

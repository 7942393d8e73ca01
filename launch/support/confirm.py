"""The question before an arm moves."""

import sys
from typing import TYPE_CHECKING

from touchgoal.runtime.errors import UserError

if TYPE_CHECKING:
    from touchgoal.control.cell.config import CellConfig


def confirm(cell: "CellConfig") -> None:
    """UserError unless the operator types which arm is to move, or it is simulated."""
    if cell.moves_nothing_real:
        return
    name = f"{cell.arm} {cell.address}".strip()
    if sys.stdin is None or not sys.stdin.isatty():
        raise UserError("nobody is there to confirm: run it in a terminal, or add --yes")
    print(f"The arm will move. One hand on its stop, nobody in reach? Type: {name}")
    if input("> ").strip() != name:
        raise UserError("not confirmed; nothing has moved")

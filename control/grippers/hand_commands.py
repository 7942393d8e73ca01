"""Commands of a Franka Hand, shared by its driver and by the environment that trains for it.

The hand takes one slow command at a time (0.8 s at most), while a policy asks for a width every
tick. When a command has ended, the newest width is sent, unless the target is still changing faster
than the hand can move. Only closing all the way is sent as a grasp, which ends at an object of any
width; an inward move that meets an object is followed by a grasp, unless the hand is to open by then.
"""

from dataclasses import dataclass
from typing import Literal

PERIOD = 0.05  # s between looks at the hand
SPEED = 0.1  # m/s; the hand's fastest
CLOSED_WIDTH = 2e-3  # m: narrower targets are grasps; smaller changes are not sent
_MOST_PASSING = 3  # looks in a row for which a changing target delays the next command

LastCommand = Literal["runs", "arrived", "stopped short"]
"""State of the last command; "arrived" before the first."""


@dataclass(frozen=True)
class HandCommand:
    """A move to a width (m), or a grasp: closing until an object is met."""

    width: float
    grasp: bool


class HandCommands:
    """Chooses the next command, once every `PERIOD`."""

    def __init__(self, width: float) -> None:
        """Begin with the hand at rest at that width (m)."""
        self._sent = self._last_target = width
        self._moves_inwards = False  # whether the last command was an inward move
        self._met = False  # whether that move has met an object
        self._passing = 0  # looks in a row with a changing target

    def next(
        self, target: float, width: float, grasped: bool, last: LastCommand
    ) -> HandCommand | None:
        """Return the command to send now, if any, for the newest width asked for (m).

        `width` (m) and `grasped` are reported by the hand; `last` is the state of the last command.
        """
        passes = self._passes(target)
        if last == "runs":
            return None
        self._met |= self._moves_inwards and last == "stopped short"
        self._moves_inwards = False
        if self._met and target < width:
            self._met = False
            return HandCommand(target, grasp=True)
        if passes or abs(target - self._sent) <= CLOSED_WIDTH:
            return None
        self._sent = target
        if grasped and target < width:
            return None  # the grasp goes on: it holds by force
        self._moves_inwards, self._met = CLOSED_WIDTH < target < width, False
        return HandCommand(target, grasp=target <= CLOSED_WIDTH)

    def _passes(self, target: float) -> bool:
        """Return whether the target still changes faster than the hand can move."""
        changed, self._last_target = abs(target - self._last_target), target
        passes = target > CLOSED_WIDTH and changed > SPEED * PERIOD
        self._passing = self._passing + 1 if passes else 0
        return 0 < self._passing <= _MOST_PASSING

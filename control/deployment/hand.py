"""State of the hand from its readings: it holds an object, has lost it, or does not follow."""

import numpy as np
from jaxtyping import Float

from touchgoal.control.interfaces import GripperReading
from touchgoal.control.motion.tool import Tool
from touchgoal.runtime.errors import UserError

_CONFIRMING = 2  # readings in a row that must agree before an object counts as held
_SLIPPED = 0.003  # m that the fingers close further when the object is gone
_LIFTED = 0.005  # m above where it was grasped: no longer carried by the table
_MOVES = 0.001  # m, least change of width between readings of a moving hand
_CLOSING_ERROR = 0.003  # m above the commanded width at which a closed hand may stand
# Share of the stroke that an open hand may stand below the command: one that was homed with
# fingertips mounted does not open as far as its model.
_OPENING_ERROR = 0.25
_REACTION_TIME = 0.5  # s from a command to its answer, besides the motion


def require_empty_hand(gripper: GripperReading) -> None:
    """Raise UserError if the hand holds something before fingertips are taken as untouched."""
    if gripper.grasped:
        raise UserError(
            f"the hand holds something, {1e3 * gripper.width:.0f} mm wide, so its fingertips are not "
            "untouched: open the hand first (touchgoal arm open) and take it out"
        )


class HeldObject:
    """Follows the held object tick by tick."""

    def __init__(self) -> None:
        self.lost = False  # an object was held and is gone, though no command opened the hand
        # An object is held above where it was grasped; also if it was held before the first tick, when
        # its height at the grasp is unknown.
        self.carried = False
        self._held_ticks, self._ticks = 0, 0
        self._width = self._height = 0.0  # m, when it was grasped

    def update(self, gripper: GripperReading, commanded: float, height: float) -> None:
        """Take the next reading, the width (m) commanded before it, and the TCP's height (m)."""
        self._ticks += 1
        if gripper.grasped:
            self._held_ticks += 1
            if self._held_ticks == _CONFIRMING:
                self._width = gripper.width
                self._height = -float("inf") if self._ticks == _CONFIRMING else height
            self.carried = self._held_ticks >= _CONFIRMING and height > self._height + _LIFTED
            return
        held = self._held_ticks >= _CONFIRMING
        closing = commanded <= self._width
        if held and closing and gripper.width > self._width - _SLIPPED:
            return  # a driver may report motion for a moment
        self.lost = self.lost or (held and closing)
        self._held_ticks, self.carried = 0, False


class HandMonitor:
    """Finds a hand that does not move as commanded, or reports an object that no fingertip touches.

    Once a command is sent the width must change, or an object be grasped, within stroke / speed +
    0.5 s.
    """

    def __init__(self, tool: Tool) -> None:
        opened = tool.stroke[1] - tool.stroke[0]
        self._timeout = opened / tool.speed + _REACTION_TIME
        self._opening_error = _OPENING_ERROR * opened
        self._width = -np.inf  # m, when it last moved
        self._still_since = self._untouched_since = np.inf  # s

    def update(
        self,
        gripper: GripperReading,
        commanded: float,
        sent_at: float,
        indentation: Float[np.ndarray, "2"] | None,
        time: float,
    ) -> str:
        """Return what is wrong at a time (s); empty if nothing.

        `commanded` (m) is the width before the reading, sent at a time (s); `indentation` of both
        gels in m, None without fingertips.
        """
        moves = abs(gripper.width - self._width) > _MOVES
        if moves:
            self._width = gripper.width
        still = not moves and not self._follows(gripper, commanded)
        self._still_since = min(self._still_since, sent_at) if still else np.inf
        untouched = gripper.grasped and indentation is not None and not indentation.any()
        self._untouched_since = min(self._untouched_since, sent_at) if untouched else np.inf
        if (still := time - self._still_since) > self._timeout:
            return (
                f"the hand does not follow: commanded {1e3 * commanded:.0f} mm, is "
                f"{1e3 * gripper.width:.0f} mm for {still:.1f} s"
            )
        if (untouched := time - self._untouched_since) > self._timeout:
            return (
                f"the hand reports an object {1e3 * gripper.width:.0f} mm wide, but neither fingertip "
                f"has touched anything for {untouched:.1f} s"
            )
        return ""

    def _follows(self, gripper: GripperReading, commanded: float) -> bool:
        if commanded > gripper.width:
            return commanded - gripper.width <= self._opening_error
        return gripper.grasped or gripper.width - commanded <= _CLOSING_ERROR

"""What the hand holds, from the gripper's readings: whether it is lost, whether it hangs in the air."""

from touchgoal.control.interfaces import GripperReading

_FELT = 2  # readings in a row that must say so before something counts as held
_SLIPPED = 0.003  # m that the fingers close further when what they held is gone
_LIFTED = 0.005  # m above where it was grasped: no longer carried by the table


class HeldObject:
    """Follows a gripper tick by tick.

    Attributes:
        lost: whether something was held and is gone, though nobody opened the hand.
        carried: whether something is held above where it was grasped; also if it was held before the
            first tick, when nobody knows from where.
    """

    def __init__(self) -> None:
        self.lost = self.carried = False
        self._seen, self._ticks = 0, 0
        self._width = self._height = 0.0  # m, when it was grasped

    def update(self, gripper: GripperReading, commanded: float, height: float) -> None:
        """The next reading, the width (m) commanded before it, and the TCP's height (m)."""
        self._ticks += 1
        if gripper.grasped:
            self._seen += 1
            if self._seen == _FELT:
                self._width = gripper.width
                self._height = -float("inf") if self._ticks == _FELT else height
            self.carried = self._seen >= _FELT and height > self._height + _LIFTED
            return
        held = self._seen >= _FELT
        closing = commanded <= self._width
        if held and closing and gripper.width > self._width - _SLIPPED:
            return  # a driver that says for a moment that it moves
        self.lost = self.lost or (held and closing)
        self._seen, self.carried = 0, False

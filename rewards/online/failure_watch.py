"""Recognition of a run that has failed: its cost has risen, and stays there."""


class FailureWatch:
    """Watches the cost of a run tick by tick.

    The run has failed once the cost has stayed `rise` above its lowest value so far for `ticks`
    ticks in a row: an object lost, or carried away from its goal. A run that gets nowhere keeps its
    cost and is left to its time limit.
    """

    def __init__(self, rise: float, ticks: int) -> None:
        self._rise, self._ticks = rise, ticks
        self._lowest, self._above = float("inf"), 0

    def update(self, cost: float) -> bool:
        """Take the cost of the next tick; return whether the run has failed."""
        self._lowest = min(self._lowest, cost)
        self._above = self._above + 1 if cost > self._lowest + self._rise else 0
        return self._above >= self._ticks

"""Figures of a run of the control loop."""

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.tactile.light_gain import LightWatch

SLOW_ARM = 0.95  # share of real time below which an arm's clock means a twin that cannot keep up
_LIGHT_TICKS = 10  # from one look at the fingertips' light to the next
_floats = partial(array, "d")


@dataclass
class RunLog:
    """Figures of a run. Its ticks (observation and command by key) go to `record`, and are not kept."""

    record: Callable[[Observation], None] = lambda tick: None
    ticks: int = 0
    first: Observation = field(default_factory=dict)  # the run's first tick
    newest: Observation = field(default_factory=dict)  # and its last
    max_force: float = 0.0  # on the hand, N
    light: LightWatch = field(default_factory=LightWatch)
    # lateness, answer_times, ages: s by which each tick began late, that the actor took, and of each
    # observation
    lateness: array = field(default_factory=_floats)
    answer_times: array = field(default_factory=_floats)
    ages: array = field(default_factory=_floats)
    limit_counts: dict[str, int] = field(default_factory=dict)  # commands changed, by limit
    # the loop's and the arm's clock at each tick in turn, s
    clocks: array = field(default_factory=_floats)

    def add(self, tick: Observation) -> None:
        """Take the next tick."""
        if self.ticks % _LIGHT_TICKS == 0:
            self.light.update(tick)
        self.first, self.newest = self.first or tick, tick
        self.max_force = max(self.max_force, float(np.linalg.norm(tick[ft.WRENCH][:3])))
        self.ages.append(tick[ft.AGE].item())
        self.ticks += 1
        self.record(tick)

    @property
    def arm_pace(self) -> float:
        """Pace of the arm's clock as a share of real time, in the median second; 1 if unknown.

        Below 1 it is a twin on a machine that is too slow for it, which looks like an arm that does
        not follow.
        """
        ticks = np.array(self.clocks).reshape(-1, 2)
        if len(ticks) < 2 or ticks[-1, 0] - ticks[0, 0] < 1:
            return 1.0
        seconds = np.arange(ticks[0, 0], ticks[-1, 0] + 1e-9)
        return float(np.median(np.diff(np.interp(seconds, ticks[:, 0], ticks[:, 1]))))


def slow_arm(pace: float) -> str:
    """Return advice on an arm whose clock runs at this share of real time."""
    return (
        f"the arm's clock goes at {pace:.2f} of real time: this twin cannot keep up, and "
        "everything comes late in its time; free the machine, or start an FR3's with --lock-step"
    )

"""Force ceilings of each task: above what its demonstrations reach, below the arm's reflex."""

from dataclasses import dataclass

_MARGIN = 1.5  # by which a ceiling lies above what demonstrations reach
_MOST = 28.0  # N: the arm is stopped before it stops itself, an FR3 at 30 N (`arms/franka.py`)
_LEVER = 0.6  # m: farthest that a hand over the table is from the axis of a joint that lifts it


@dataclass(frozen=True)
class TaskForces:
    """Peaks over a task's demonstrations.

    Attributes:
        force: on the hand, N.
        indentation: depth in a gel, m, as `control.tactile.indentation` measures it.
        episodes: number of successful demonstrations, seeds from 30000.
    """

    force: float
    indentation: float
    episodes: int

    @property
    def force_ceiling(self) -> float:
        """Force (N) on the hand above which a run of this task is stopped."""
        return min(_MARGIN * self.force, _MOST)

    @property
    def torque_ceiling(self) -> float:
        """Torque (Nm) that this force causes in a joint, so that neither limit comes first."""
        return _LEVER * self.force_ceiling

    @property
    def indentation_ceiling(self) -> float:
        """Depth (m) in a gel, likewise; `deepest_readable` bounds it for a sensor."""
        return _MARGIN * self.indentation


# By `touchgoal benchmark task-ceilings`: 60 episodes of pick-place, and 60 with --feedback; 29 of the maze with
# the bead led astray at 4 mm/s, and for its indentation the first six without.
TASK_FORCES: dict[str, TaskForces] = {
    "pick-place": TaskForces(force=16.5, indentation=2.1e-3, episodes=120),
    "bead-maze": TaskForces(force=17.9, indentation=1.15e-3, episodes=29),
}

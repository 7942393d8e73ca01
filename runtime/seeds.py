"""Random seeds of episodes: one named range for each purpose; ranges do not overlap.

A scene is drawn from its episode's seed, so two purposes that share a seed share a scene. Whatever
is trained, chosen or reported takes its seeds from here.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from touchgoal.runtime.errors import UserError


@dataclass(frozen=True)
class SeedRange:
    """Consecutive seeds."""

    start: int
    count: int

    @property
    def stop(self) -> int:
        """First seed after the range."""
        return self.start + self.count

    def first(self, episodes: int, option: str) -> int:
        """Return the first seed; UserError, which names the option, if there are fewer seeds."""
        if episodes > self.count:
            raise UserError(f"{option} is {episodes}; at most {self.count} have seeds of their own")
        return self.start

    def __iter__(self) -> Iterator[int]:
        """Iterate over the seeds."""
        return iter(range(self.start, self.stop))


_STEP = 100_000

TRAINING = SeedRange(0, _STEP)  # demonstrations to learn from
VALIDATION = SeedRange(1 * _STEP, _STEP)  # demonstrations to judge a training by
DISTURBED = SeedRange(2 * _STEP, _STEP)  # demonstrations during which the arm is pushed
CORRECTIONS = tuple(SeedRange((3 + k) * _STEP, _STEP) for k in range(5))  # by round of DAgger
EVALUATION = SeedRange(1_000_000, 1_000_000)  # default of run-policy, evaluate, twin
MODEL_SELECTION = SeedRange(2_000_000, 1_000_000)  # trials that choose a snapshot
REWARD_GOALS = SeedRange(3_000_000, _STEP)  # goal episodes of benchmark reward-quality
REWARD_TEST = SeedRange(3_100_000, 800_000)  # its judged episodes
REWARD_TRAINING = SeedRange(3_900_000, _STEP)  # successes that its units and value are fitted on
POSE_TRAINING = SeedRange(4_000_000, 900_000)  # scenes that a pose estimator learns from
POSE_VALIDATION = SeedRange(4_900_000, _STEP)
POLICY_TEST = SeedRange(5_000_000, 1_000_000)  # benchmark policy-delay, bead-maze
DEPLOY_TEST = SeedRange(6_000_000, 2_000_000)  # benchmark deploy
IMPROVEMENT = SeedRange(8_000_000, 1_000_000)  # runs of improve that a policy is trained on
DEMO = SeedRange(9_000_000, 1_000_000)

WIRES: dict[str, SeedRange] = {  # shapes of wires have seeds apart from the episodes'
    "test": SeedRange(0, 1_000_000),
    "validation": SeedRange(1_000_000, 1_000_000),
    "training": SeedRange(2_000_000, 1_000_000),
}

"""Success of an episode: its last cost against a threshold from successful demonstrations.

Split conformal prediction (Vovk et al. 2005; Angelopoulos and Bates 2021, arXiv 2107.07511): of the
last costs of k demonstrations the threshold is the ceil((k + 1)(1 - a))-th smallest. A success from
the same scene and to the same goals is then rejected with a probability of at most a, over the draw
of demonstrations and of the success. How many failures pass is not bounded: only recorded failures
can tell. The k demonstrations must have fitted nothing else: those that fitted a normalizer or a
value cost too little.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from touchgoal.rewards.curves import FUSED
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.features.embedded import EmbeddedEpisode, EmbeddedGoal
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.value import Value
from touchgoal.runtime.atomic_write import write_file
from touchgoal.runtime.errors import UserError

SUCCESS = "success.json"  # name of the file, beside the normalizer
REJECTED = 0.1  # default bound on the share of successes that are rejected


@dataclass(frozen=True)
class SuccessThreshold:
    """Largest last cost that counts as success."""

    cost: float  # in the unit of the curve
    curve: str  # name of the curve, such as "fused"
    rejected: float  # bound on the share of successes that are rejected
    demonstrations: int  # number of last costs behind it

    def accepts(self, last_cost: float) -> bool:
        """Return whether an episode with this last cost ended in success."""
        return last_cost <= self.cost

    def __str__(self) -> str:
        return (
            f"success: last cost '{self.curve}' of at most {self.cost:.3f}; it rejects at most "
            f"{self.rejected:.0%} of successes like its {self.demonstrations} demonstrations"
        )

    def save(self, path: Path) -> None:
        """Write JSON, atomically."""
        write_file(path, (json.dumps(asdict(self), indent=2) + "\n").encode())


def fit_success(costs: Sequence[float], rejected: float = REJECTED) -> SuccessThreshold:
    """Return the threshold from the last costs of demonstrations that fitted nothing else.

    UserError: too few demonstrations for the bound.

    Args:
        costs: last fused costs, one per demonstration, to the kind of goals that later episodes are
            measured against.
        rejected: bound on the share of successes that are rejected.
    """
    check_demonstrations(len(costs), rejected)
    rank = _rank(len(costs), rejected)
    return SuccessThreshold(float(np.sort(costs)[rank - 1]), FUSED, rejected, len(costs))


def check_demonstrations(demonstrations: int, rejected: float = REJECTED) -> None:
    """Raise UserError if a bound needs more demonstrations."""
    if not 0 < rejected < 1:
        raise UserError(f"the share of rejected successes is {rejected:g}; it must be in (0, 1)")
    if _rank(demonstrations, rejected) > demonstrations:
        needed = next(k for k in range(1, 10**6) if _rank(k, rejected) <= k)
        raise UserError(
            f"to reject at most {rejected:.0%} of successes, a threshold needs at least {needed} "
            f"demonstrations (10 % needs 9, 5 % needs 19); there are {demonstrations}"
        )


def last_costs(
    episodes: Sequence[EmbeddedEpisode],
    ends: SuccessfulEnds,
    normalizer: DistanceNormalizer,
    value: Value | None,
) -> list[float]:
    """Return the last fused cost of each episode to the ends of successes with its object.

    UserError: there is no end with its object, or the normalizer has no units to fuse parts by.
    """
    costs = []
    for episode in episodes:
        goal = EmbeddedGoal(ends.for_trajectory(episode, "the successes that are fitted"))
        curves = compute_curves(episode, goal, normalizer, value).costs
        if FUSED not in curves:
            raise UserError(
                "a success threshold needs the parts of a cost: two fitted successes must share an "
                "object"
            )
        costs.append(float(curves[FUSED][-1]))
    return costs


def load_success_threshold(normalizer: str | Path | None) -> SuccessThreshold | None:
    """Return the threshold beside a normalizer's file; None if there is none, or no such file.

    UserError: the file is no threshold.
    """
    if normalizer is None or not Path(normalizer).is_file():
        return None
    path = Path(normalizer).with_name(SUCCESS)
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text())
        if content.keys() != {field.name for field in fields(SuccessThreshold)}:
            raise ValueError
        return SuccessThreshold(**content)
    except (ValueError, TypeError, AttributeError):
        raise UserError(f"{path} is no success threshold: fit it anew or delete it") from None


def _rank(demonstrations: int, rejected: float) -> int:
    """Return ceil((k + 1)(1 - a)), free of rounding: (9 + 1)(1 - 0.1) is 9."""
    return math.ceil(round((demonstrations + 1) * (1 - rejected), 9))

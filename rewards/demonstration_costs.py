"""Last costs of successful demonstrations, from which a success threshold is fitted."""

from collections.abc import Sequence

from touchgoal.rewards.distance.embedding_distance import compute_curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.distance.parts import FUSED
from touchgoal.rewards.features.embedded import EmbeddedEpisode, goal_at_every_frame
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.value.value import Value
from touchgoal.runtime.errors import UserError


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
        goal = goal_at_every_frame(ends.for_trajectory(episode, "the successes that are fitted"))
        curves = compute_curves(episode, goal, normalizer, value).costs
        if FUSED not in curves:
            raise UserError(
                "a success threshold needs the parts of a cost: two fitted successes must share an "
                "object"
            )
        costs.append(float(curves[FUSED][-1]))
    return costs

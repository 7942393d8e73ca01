"""Last costs of successful demonstrations, for a success threshold, and of failures made from them."""

from collections.abc import Callable, Sequence

from touchgoal.episodes.outcomes.generate import MADE, made_failures
from touchgoal.episodes.schema import Episode
from touchgoal.rewards.distance.embedding_distance import compute_curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.distance.parts import FUSED
from touchgoal.rewards.features.embedded import EmbeddedEpisode, goal_at_every_frame
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.success import SuccessThreshold
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


def accepted_failures(
    threshold: SuccessThreshold,
    successes: Sequence[Episode],
    last_cost: Callable[[Episode], float],
) -> dict[str, tuple[int, int]]:
    """Return how many failures made from successes pass a threshold, of how many, by kind.

    The kind "wrong_object" takes its touch from the next success with another object; without one it
    is not made. A failure whose images `last_cost` refuses (UserError) does not pass.
    """
    passed: dict[str, list[bool]] = {kind: [] for kind in MADE}
    for k, success in enumerate(successes):
        later = [*successes[k + 1 :], *successes[:k]]
        others = [e for e in later if e.meta.get("object") != success.meta.get("object")]
        for kind, failure in made_failures(success, (others or [success])[0]).items():
            if kind == "wrong_object" and not others:
                continue
            try:
                passed[kind].append(threshold.accepts(last_cost(failure)))
            except UserError:
                passed[kind].append(False)
    return {kind: (sum(accepted), len(accepted)) for kind, accepted in passed.items() if accepted}

"""Fitting of a `Judge`: end costs of successes, none of which fitted what measures it, and of failures."""

from collections.abc import Sequence

from touchgoal.rewards.distance.fit_normalizer import fit_units
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.judging.end_state import end_cost, end_costs
from touchgoal.rewards.judging.judge import Judge
from touchgoal.rewards.value import Value, fit_value

_FOLDS = 4


def fit_judge(
    successes: Sequence[EmbeddedEpisode], failures: Sequence[EmbeddedEpisode], value: Value | None
) -> Judge:
    """Return the judge of successes, each measured by the other three of 4 folds, and of failures.

    Units, goals and, where `value` of all successes is given, a value are fitted anew to each three
    folds; failures are measured by all successes. An episode whose object no success (in another fold)
    has is left out. UserError: fewer than 9 successes are left.
    """
    by_object = sorted(successes, key=lambda e: e.object)  # each object in as many folds as can be
    costs: list[float] = []
    for fold in range(_FOLDS):
        others = [e for i, e in enumerate(by_object) if i % _FOLDS != fold]
        refitted = None if value is None else fit_value(others, value.config.task)
        costs += _costs(by_object[fold::_FOLDS], others, refitted)
    return Judge(tuple(costs), tuple(_costs(failures, successes, value)))


def _costs(
    episodes: Sequence[EmbeddedEpisode], successes: Sequence[EmbeddedEpisode], value: Value | None
) -> list[float]:
    units, ends = fit_units(successes), SuccessfulEnds.of(successes)
    measured = [e for e in episodes if e.object in ends.objects]
    goals = [ends.for_trajectory(e, "the successes") for e in measured]
    return [
        end_cost(end_costs(e.features, e.fps, goal, units, value))
        for e, goal in zip(measured, goals, strict=True)
    ]

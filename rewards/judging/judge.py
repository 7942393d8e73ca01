"""Judge of episodes: success, failure, or unsure, by how things rest at the end (`end_state`).

Two limits of the end's cost, by split conformal prediction (Vovk et al. 2005; Angelopoulos and Bates 2021,
arXiv 2107.07511) from known successes and failures that fitted nothing else: at most 10 % of successes
are called failures, at most 10 % of failures successes. Between the limits a judge is unsure. Without 20
failures, which must be made on purpose, success is told only up to the stricter cost that two in five
successes exceed; how many failures pass is then unknown.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from touchgoal.encoders.pretrained import DEFAULT_ENCODER
from touchgoal.episodes.outcomes.judged import Verdict
from touchgoal.rewards.distance.fit_normalizer import fit_units
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.judging.end_state import end_cost, end_costs
from touchgoal.rewards.value import Value, fit_value
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import read_json, write_json

FIT_JUDGE = "fit one with touchgoal fit-normalizer --judge"
SHIPPED_JUDGE = DEFAULT_ENCODER.name
"""Name of the judge that ships, of simulated pick-and-place."""
JUDGE = "judge.json"
"""Name of the file, beside the normalizer."""
WRONG = 0.1  # bound on the share of successes called failures, and of failures called successes
_FOLDS = 4  # of the successes: three fit what measures the fourth
_DOUBTED = 0.4  # share of successes that are not called so where failures are missing
LEAST_SUCCESSES, LEAST_FAILURES = 9, 20

_FAR = 0.5  # cost of a part that is named as a reason: 1.5 spreads of successes
_SAYS = {
    "value": "the images do not look done",
    "wrist": "the wrist camera does not see what it sees at the end of successes",
    "scene": "the wrist camera sees something out of place",
    "put_down": "nothing was put down",
    "press": "the arm presses harder than at the end of successes",
    "object": "what was carried feels otherwise",
    "slip": "it slipped in the hand",
    "held": "the fingertips touch otherwise than at the end of successes",
}


@dataclass(frozen=True)
class Judgement:
    """What a judge says of one episode."""

    verdict: Verdict
    cost: float  # of the end, in [0, 1]
    parts: Mapping[str, float]  # cost of each part, see `end_state`
    reasons: tuple[str, ...]  # what differs most from successes, worst first

    def __str__(self) -> str:
        reasons = f": {'; '.join(self.reasons)}" if self.reasons else ""
        return f"{self.verdict} (cost {self.cost:.2f}){reasons}"


@dataclass(frozen=True)
class Judge:
    """Costs of known ends, and the limits that follow from them."""

    successes: tuple[float, ...]  # costs of ends of successes
    failures: tuple[float, ...] = ()  # and of failures, made on purpose or corrected by a person
    towers: str = ""  # that saw the images, see `load_towers`; "": those of the touch encoder

    def __post_init__(self) -> None:
        """Raise UserError if there are too few successes."""
        if len(self.successes) < LEAST_SUCCESSES:
            raise UserError(
                f"a judge needs at least {LEAST_SUCCESSES} successes that fitted nothing else, these "
                f"are {len(self.successes)}"
            )

    @property
    def limits(self) -> tuple[float, float]:
        """Largest cost of what is called success, and least cost of what is called failure."""
        refuse = _quantile(self.successes, WRONG)
        if len(self.failures) < LEAST_FAILURES:
            return min(_quantile(self.successes, _DOUBTED), refuse), refuse
        accept = -_quantile([-cost for cost in self.failures], WRONG)
        middle = (accept + refuse) / 2
        return (accept, refuse) if accept < refuse else (middle, middle)

    def verdict(self, cost: float) -> Verdict:
        """Return what an end of this cost is called."""
        accept, refuse = self.limits
        return "success" if cost <= accept else "failure" if cost > refuse else "unsure"

    def judge(self, parts: Mapping[str, float]) -> Judgement:
        """Return the judgement of an end, by the cost of its parts."""
        cost = end_cost(parts)
        far = sorted((n for n in parts if parts[n] > _FAR), key=lambda name: -parts[name])
        reasons = tuple(_SAYS.get(n, _SAYS["wrist"].replace("wrist", n)) for n in far)
        return Judgement(self.verdict(cost), cost, parts, reasons)

    def corrected(self, cost: float, success: bool) -> "Judge":
        """Return the judge with one more known end."""
        if success:
            return replace(self, successes=(*self.successes, cost))
        return replace(self, failures=(*self.failures, cost))

    def __str__(self) -> str:
        return (
            f"judge of {len(self.successes)} successes and {len(self.failures)} failures: at most "
            f"{WRONG:.0%} of such successes are called failures, and "
            + (
                f"at most {WRONG:.0%} of such failures successes"
                if len(self.failures) >= LEAST_FAILURES
                else f"how many failures are called successes is unknown: show it {LEAST_FAILURES}"
            )
        )

    def save(self, path: Path) -> None:
        """Write JSON, atomically."""
        write_json(path, self)

    @classmethod
    def load(cls, path: Path) -> "Judge":
        """Read what `save` wrote; UserError: no such file, or another one."""
        return read_json(path, cls, f"{path} is no judge: {FIT_JUDGE}")


def find_judge(name: str | Path) -> Path:
    """Return the folder of a judge, given itself or as the name of an encoder that ships with one.

    UserError: it has none.
    """
    for folder in (Path(name), DEFAULT_ENCODER.parent / name):
        if (folder / JUDGE).is_file():
            return folder
    raise UserError(f"there is no {Path(name) / JUDGE}: {FIT_JUDGE}, or give {SHIPPED_JUDGE}")


def _quantile(costs: Sequence[float], beyond: float) -> float:
    """Return the ceil((k + 1)(1 - beyond))-th smallest cost, the largest if there are too few."""
    rank = math.ceil(round((len(costs) + 1) * (1 - beyond), 9))
    return float(np.sort(costs)[min(rank, len(costs)) - 1])


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

"""MMWand's claims about dense costs (section V-E, Figures 8 and 9), judged on successes.

Definitions were fixed before the first result: a curve "drops" at the first frame by which half of
its net drop has fallen; peaks of an episode's curves count above the largest of their noise levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.bootstrap import mean_interval
from benchmarks.papers.reward_quality.measures import Judged
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.metrics import CurveMetrics, measure_curve

_WITHIN = 0.15  # s, three frames at 20 Hz
_DRAWS = 10_000
_PAPER = ("image", "tactile", "image+tactile")


@dataclass(frozen=True)
class Claim:
    """One claim with its verdict."""

    claim: str
    verdict: str  # "holds", "fails", or "unsure" where the interval of a mean includes 0
    evidence: str

    @property
    def line(self) -> str:
        """Return the claim's line in the table."""
        return f"  {self.verdict:<8}{self.claim}: {self.evidence}"


def judge_claims(
    own: Sequence[Curves], words: Sequence[Curves], untouched: Sequence[Judged]
) -> list[Claim]:
    """Judge the claims of Figures 8 and 9, and that an untouched episode does not look done.

    Args:
        own: curves of successes to their own last frame.
        words: the same with a sentence as the goal of touch; none if touch knows no words.
        untouched: episodes that never touch.
    """
    within = max(1, round(_WITHIN * own[0].fps))
    figure_8 = _figure_8([_metrics_at_common_noise(curves) for curves in own], within)
    return [*figure_8, *([_figure_9(words)] if words else []), _untouched(untouched)]


def _figure_8(own: Sequence[dict[str, CurveMetrics]], within: int) -> list[Claim]:
    lags = [m["tactile"].contact_lag for m in own]
    known = [lag for lag in lags if lag is not None]
    soon = SuccessRate(sum(lag is not None and 0 <= lag <= within for lag in lags), len(lags))
    peaks = {n: [float(m[n].peaks) for m in own] for n in ("image", "image+tactile")}
    peaks_saved = [a - b for a, b in zip(peaks["image"], peaks["image+tactile"], strict=True)]
    earlier = {f: _frames_earlier(own, f) for f in ("t_drop_50", "t_drop_25", "t_drop_10")}
    return [
        Claim(
            f"the tactile curve drops within {within} frames of true contact",
            _verdict_of_rate(soon),
            f"{soon} of episodes, lags {min(known)} to {max(known)} frames",
        ),
        Claim(
            "the fused curve has fewer peaks than the image curve (mean)",
            _verdict_of_mean(peaks_saved),
            f"{np.mean(peaks['image+tactile']):.2f} against {np.mean(peaks['image']):.2f}, "
            f"difference {_interval(peaks_saved)}",
        ),
        Claim(
            "the fused curve drops earlier than the tactile one (mean)",
            _verdict_of_mean(earlier["t_drop_50"]),
            f"half of its drop by {_interval(earlier['t_drop_50'])} frames "
            f"(a quarter by {_interval(earlier['t_drop_25'])}, "
            f"a tenth by {_interval(earlier['t_drop_10'])})",
        ),
    ]


def _figure_9(words: Sequence[Curves]) -> Claim:
    falls = [_fall_after_contact(curves) for curves in words]
    fell = SuccessRate(sum(f > 0 for f in falls), len(falls))
    return Claim(
        "with a sentence as goal the cost falls after contact",
        _verdict_of_rate(fell),
        f"{fell} of episodes, by {_interval(falls)} of the way from start to goal",
    )


def _untouched(untouched: Sequence[Judged]) -> Claim:
    costs = [e.costs["tactile"] for e in untouched]
    remaining = [float(c[-1] / np.median(c[:5])) for c in costs]
    return Claim(
        "an episode that never touches keeps 3/4 of its tactile cost",
        "holds" if min(remaining) >= 0.75 else "fails",
        f"least {min(remaining):.2f}, mean {np.mean(remaining):.2f} of where it began",
    )


def _frames_earlier(episodes: Sequence[dict[str, CurveMetrics]], drop: str) -> list[float]:
    """Return the frames by which the fused curve drops before the tactile one, where both drop."""
    pairs = [(getattr(m["tactile"], drop), getattr(m["image+tactile"], drop)) for m in episodes]
    return [float(a - b) for a, b in pairs if a is not None and b is not None]


def _metrics_at_common_noise(curves: Curves) -> dict[str, CurveMetrics]:
    """Return metrics with one noise level for all curves of the paper."""
    contact, costs = curves.contact.frame, {name: curves.costs[name] for name in _PAPER}
    eps = max(measure_curve(d, contact).eps for d in costs.values())
    return {n: measure_curve(d, contact, eps) for n, d in costs.items()}


def _fall_after_contact(curves: Curves) -> float:
    """Return the fall of the text cost from the second before contact to the second after it."""
    d, contact = curves.costs["text"], curves.contact.frame
    assert contact is not None  # the expert's successes touch
    second = round(curves.fps)
    before, after = d[max(0, contact - second) : contact], d[contact + 3 :][:second]
    return float(np.median(before) - np.median(after))


def _verdict_of_rate(rate: SuccessRate) -> str:
    return "holds" if rate.successes == rate.trials else "fails"


def _verdict_of_mean(values: Sequence[float]) -> str:
    """Return the verdict on a mean that is claimed to be positive."""
    if not values:
        return "unsure"
    low, high = mean_interval(values, _DRAWS)
    return "holds" if low > 0 else "fails" if high < 0 else "unsure"


def _interval(values: Sequence[float]) -> str:
    if not values:
        return "none"
    low, high = mean_interval(values, _DRAWS)
    return f"{np.mean(values):.2f} [{low:.2f}, {high:.2f}]"

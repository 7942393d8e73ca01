"""MMWand's claims about dense costs (section V-E, Figures 8 and 9), on expert episodes and failures.

Definitions were fixed before the first result: a curve "drops" at the first frame by which half of
its net drop has fallen; peaks of an episode's curves count above the largest of their noise levels.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from touchgoal.benchmarks.options import CORES, BenchmarkOptions
from touchgoal.encoders import pretrained
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.recording import EpisodeSpec, collect
from touchgoal.episodes.schema import MetaValue
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.embedding_distance import compute_curves
from touchgoal.rewards.distance.normalizer import NORMALIZER, DistanceNormalizer
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.goals import EpisodeEnd, Goal, OwnFrame, Sentence
from touchgoal.rewards.metrics import CurveMetrics, measure_curve
from touchgoal.rewards.report.summary import metrics_table
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import OUTCOMES
from touchgoal.sim_envs.scene.objects import CATALOGUE


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark reward-quality."""

    encoder: str = "gelsight_mini"
    """Touch encoder, by name or folder; the simulated sensor is the encoder's."""
    episodes: Count = 20
    """Held-out episodes of each outcome."""
    workers: Count = CORES
    """Processes that simulate."""


SENTENCES = {  # new wordings: no training saw these sentences
    "glass_ball": "a hard smooth round object",
    "golf_ball": "a hard ball full of little dents",
    "foam_ball": "a squishy sphere with a coarse surface",
    "yarn_ball": "a ball wrapped in woven thread",
    "wooden_block": "a solid plank with fine grooves",
    "brick": "a gritty hard slab of stone",
    "cushion": "a flat squashy pad of fabric",
    "toy_brick": "a plastic block covered with studs",
    "soda_can": "a slick metal cylinder",
    "bottle_cap": "a round lid with grip ridges around it",
    "rope_coil": "a braided cord wound into a roll",
    "cork": "a slightly grainy stopper",
    "candle": "a long smooth wax stick",
    "corn_cob": "a long cob covered with kernels",
    "sausage": "a long soft tube with smooth skin",
    "brush_handle": "a hard grip with ribs along it",
    "pebble": "an irregular smooth hard stone",
    "walnut": "a wrinkled hard shell",
    "clay_lump": "a lump of smooth soft clay",
    "rag_bundle": "a soft heap of woven cloth",
}
_GOAL_ATTEMPTS = 3  # the expert places 98 of 100


@dataclass(frozen=True)
class HeldOutEpisode:
    """One held-out episode, measured against three kinds of goal."""

    outcome: str
    own: Curves  # to its own last frame (Figure 8)
    words: Curves  # touch to a sentence (Figure 9), image to its own last frame
    other: Curves  # to the end of another, successful episode with the same object


def run(config: Config) -> dict[str, Any]:
    """Record, measure and judge."""
    directory = pretrained.find_encoder(config.encoder)
    encoder = pretrained.load_encoder(directory)
    normalizer = DistanceNormalizer.load(directory / NORMALIZER)
    embedder = EpisodeEmbedder(load_towers(encoder.towers or "offline"), encoder)
    sensor = str(encoder.config.sensor)
    with tempfile.TemporaryDirectory() as folder:
        tests = record_and_measure(config, sensor, embedder, normalizer, Path(folder))
    successes = [t for t in tests if t.outcome == "success"]
    claims = judge_claims(successes, [t for t in tests if t.outcome == "never_touch"])
    auc = {outcome: failure_auc(tests, outcome) for outcome in OUTCOMES if outcome != "success"}
    parts = [
        "Figure 8: goal = own last frame, held-out successful episodes",
        metrics_table([t.own for t in successes], legend=False),
        "\nFigure 9: the touch goal replaced by a sentence never trained on",
        metrics_table([t.words for t in successes]),
        "\nclaims",
        *(c.line for c in claims),
        "\nsuccess or not, from the last cost to another episode's end (area under ROC)",
        failure_table(auc),
    ]
    return {
        "table": "\n".join(parts),
        "claims": [vars(c) for c in claims],
        "auc": auc,
        "episodes": [
            {"outcome": t.outcome}
            | {
                kind: {name: m.as_dict() for name, m in curves.metrics().items()}
                for kind, curves in (("own", t.own), ("words", t.words))
            }
            for t in tests
        ],
    }


def record_and_measure(
    config: Config,
    sensor: str,
    embedder: EpisodeEmbedder,
    normalizer: DistanceNormalizer,
    folder: Path,
) -> list[HeldOutEpisode]:
    """Simulate goal and test episodes with one sensor and measure each test."""
    names = [list(CATALOGUE)[i % len(CATALOGUE)] for i in range(config.episodes)]
    ends = collect_goals(names, sensor, folder, config.workers)
    tests = []
    for k, outcome in enumerate(OUTCOMES):
        env = PickPlaceConfig(distractors=int(outcome == "wrong_object"), sensor=sensor)
        first = seeds.REWARD_TEST.start + 1000 * k
        jobs = [EpisodeSpec(first + i, outcome, {"object": n}) for i, n in enumerate(names)]
        collect(folder / outcome, env, jobs, config.workers)
        episodes = EpisodeSet(folder / outcome)
        for i in track(range(len(episodes)), f"measuring {outcome}", "episode"):
            episode = embedder.embed_episode(episodes.read(i), episodes.fps, f"{outcome}#{i}")
            sentence = Sentence(SENTENCES[names[i]])
            goals = (
                Goal(image=OwnFrame(), tactile=OwnFrame()),
                Goal(image=OwnFrame(), text=sentence),
                Goal(image=ends[i], tactile=ends[i], text=sentence),
            )
            embedded = (embedder.embed_goal(goal, episode) for goal in goals)
            curves = (compute_curves(episode, goal, normalizer) for goal in embedded)
            tests.append(HeldOutEpisode(str(episodes.meta(i)["outcome"]), *curves))
    return tests


def collect_goals(
    names: Sequence[str], sensor: str, folder: Path, workers: int
) -> list[EpisodeEnd]:
    """Return the end of a successful episode with each object; UserError after too many failures."""
    ends: dict[int, EpisodeEnd] = {}
    for attempt in range(_GOAL_ATTEMPTS):
        missing = [i for i in range(len(names)) if i not in ends]
        if not missing:
            break
        root = folder / f"goals-{attempt}"
        first = seeds.REWARD_GOALS.start + 1000 * attempt
        jobs = [EpisodeSpec(first + i, "success", {"object": names[i]}) for i in missing]
        collect(root, PickPlaceConfig(distractors=0, sensor=sensor), jobs, workers)
        episodes = EpisodeSet(root)
        reached = [k for k in range(len(missing)) if is_goal(episodes.meta(k), sensor)]
        ends |= {missing[k]: EpisodeEnd(root, k) for k in reached}
    if len(ends) < len(names):
        failed = next(names[i] for i in range(len(names)) if i not in ends)
        raise UserError(
            f"no goal for {failed}: the expert failed {_GOAL_ATTEMPTS} times; try collect-demos "
            f"--env.objects {failed}"
        )
    return [ends[i] for i in range(len(names))]


def is_goal(meta: Mapping[str, MetaValue], sensor: str) -> bool:
    """Return whether an episode succeeded; UserError if another sensor recorded it."""
    if meta["sensor"] != sensor:
        raise UserError(f"a goal was recorded with {meta['sensor']}, the encoder is for {sensor}")
    return bool(meta["success"])


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
    successes: Sequence[HeldOutEpisode], untouched: Sequence[HeldOutEpisode]
) -> list[Claim]:
    """Judge the claims of Figures 8 and 9, and that an untouched episode does not look done."""
    own = [_metrics_at_common_noise(t.own) for t in successes]
    lags = [m["tactile"].contact_lag for m in own]
    known = [lag for lag in lags if lag is not None]
    within_3_frames = SuccessRate(sum(lag is not None and 0 <= lag <= 3 for lag in lags), len(lags))
    peaks = {n: [float(m[n].peaks) for m in own] for n in ("image", "image+tactile")}
    peaks_saved = [a - b for a, b in zip(peaks["image"], peaks["image+tactile"], strict=True)]
    frames_earlier = {f: _frames_earlier(own, f) for f in ("t_drop_50", "t_drop_25", "t_drop_10")}
    falls = [_fall_after_contact(t.words) for t in successes]
    remaining = [
        t.other.raw["tactile"][-1] / np.median(t.other.raw["tactile"][:5]) for t in untouched
    ]
    fell = SuccessRate(sum(f > 0 for f in falls), len(falls))
    return [
        Claim(
            "the tactile curve drops within 3 frames of true contact",
            _verdict_of_rate(within_3_frames),
            f"{within_3_frames} of episodes, lags {min(known)} to {max(known)} frames",
        ),
        Claim(
            "the fused curve has fewer peaks than the image curve (mean)",
            _verdict_of_mean(peaks_saved),
            f"{np.mean(peaks['image+tactile']):.2f} against {np.mean(peaks['image']):.2f}, "
            f"difference {_interval(peaks_saved)}",
        ),
        Claim(
            "the fused curve drops earlier than the tactile one (mean)",
            _verdict_of_mean(frames_earlier["t_drop_50"]),
            f"half of its drop by {_interval(frames_earlier['t_drop_50'])} frames "
            f"(a quarter by {_interval(frames_earlier['t_drop_25'])}, "
            f"a tenth by {_interval(frames_earlier['t_drop_10'])})",
        ),
        Claim(
            "with a sentence as goal the cost falls after contact",
            _verdict_of_rate(fell),
            f"{fell} of episodes, by {_interval(falls)} of the way from start to goal",
        ),
        Claim(
            "an episode that never touches keeps 3/4 of its tactile cost",
            "holds" if min(remaining) >= 0.75 else "fails",
            f"least {min(remaining):.2f}, mean {np.mean(remaining):.2f} of where it began",
        ),
    ]


def _frames_earlier(episodes: Sequence[dict[str, CurveMetrics]], drop: str) -> list[float]:
    """Return the frames by which the fused curve drops before the tactile one, where both drop."""
    pairs = [(getattr(m["tactile"], drop), getattr(m["image+tactile"], drop)) for m in episodes]
    return [float(a - b) for a, b in pairs if a is not None and b is not None]


def _metrics_at_common_noise(curves: Curves) -> dict[str, CurveMetrics]:
    """Return metrics with one noise level for all curves of an episode."""
    contact = curves.contact.frame
    eps = max(measure_curve(d, contact).eps for d in curves.costs.values())
    return {n: measure_curve(d, contact, eps) for n, d in curves.costs.items()}


def _fall_after_contact(curves: Curves) -> float:
    """Return the fall of the text cost from the second before contact to the second after it."""
    d, contact = curves.costs["text"], curves.contact.frame
    assert contact is not None  # the expert's successes touch
    second = round(curves.fps)
    before, after = d[max(0, contact - second) : contact], d[contact + 3 :][:second]
    return float(np.median(before) - np.median(after))


def failure_auc(tests: Sequence[HeldOutEpisode], outcome: str) -> dict[str, float]:
    """Return the AUC of the last cost, success against each failure, by kind of curve."""
    done, failed = (
        [t.other.costs for t in tests if t.outcome == kind] for kind in ("success", outcome)
    )
    return {
        name: _auc([costs[name][-1] for costs in done], [costs[name][-1] for costs in failed])
        for name in tests[0].other.costs
    }


def failure_table(auc: dict[str, dict[str, float]]) -> str:
    """Return the AUC table as text; 0.5 is chance."""
    lines = [f"{'failure':<15}" + "".join(f"{name:>15}" for name in next(iter(auc.values())))]
    for outcome, cells in auc.items():
        lines.append(f"{outcome:<15}" + "".join(f"{value:>15.2f}" for value in cells.values()))
    return "\n".join(lines)


def _auc(low: list[float], high: list[float]) -> float:
    """Return the share of pairs in which `high` has the larger value; ties count half."""
    return float(stats.mannwhitneyu(high, low).statistic / (len(high) * len(low)))


def _verdict_of_rate(rate: SuccessRate) -> str:
    return "holds" if rate.successes == rate.trials else "fails"


def _verdict_of_mean(values: Sequence[float]) -> str:
    """Return the verdict on a mean that is claimed to be positive."""
    low, high = _bootstrap(values)
    return "holds" if low > 0 else "fails" if high < 0 else "unsure"


def _bootstrap(values: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % percentile interval of the mean over episodes."""
    if len(set(values)) == 1:  # nothing to resample
        return values[0], values[0]
    result = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=10_000, rng=0)
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _interval(values: Sequence[float]) -> str:
    low, high = _bootstrap(values)
    return f"{np.mean(values):.2f} [{low:.2f}, {high:.2f}]"

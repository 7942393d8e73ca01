"""Simulated episodes of the benchmark: training, goals, and judged ones of every outcome."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS, TRAINING_OBJECTS
from touchgoal.episodes.format.set_files import INFO
from touchgoal.episodes.recording import EpisodeSpec, collect, episode_spec
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.sim_envs.config import Outcome, PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import OUTCOMES
from touchgoal.sim_envs.experts.pick_place_plans import LONGEST_PLAN

Scene = Literal["elsewhere", "fixed"]
"""elsewhere: places, grip force and mass are drawn anew for each episode; fixed: one start, one goal
and one grip force."""
SCENES: tuple[Scene, ...] = ("elsewhere", "fixed")
_FIXED: dict[str, Any] = {"start": (0.5, -0.1), "goal": (0.5, 0.1), "grasp_force": 10.0}
SUBOPTIMAL: tuple[Outcome, ...] = ("slow", "regrasped")
KINDS: tuple[Outcome, ...] = tuple(o for o in OUTCOMES if o not in ("success", *SUBOPTIMAL))
"""Outcomes that are failures."""

_ATTEMPTS = 6  # rounds in which what did not come out as asked is drawn again
_APART = 10_000  # between the first episodes of two outcomes


@dataclass(frozen=True)
class EpisodeBatch:
    """Episodes to record of one outcome, with the objects in turn and seeds of their own."""

    purpose: Literal["training", "goal", "calibration", "test"]
    outcome: Outcome
    count: int
    objects: tuple[str, ...]
    first_seed: int

    def specs(self, scene: Scene, done: Mapping[int, bool]) -> list[EpisodeSpec]:
        """Return what is left to record, given for recorded seeds whether they came out as asked.

        The seeds first + k, first + count + k, ... are tried in turn for the k-th episode.
        """
        options, specs = _FIXED if scene == "fixed" else {}, []
        for k in range(self.count):
            tries = range(self.first_seed + k, self.seeds.stop, self.count)
            if any(done.get(seed, False) for seed in tries):
                continue
            seed = next(seed for seed in tries if seed not in done)
            chosen = options | {"object": self.objects[k % len(self.objects)]}
            specs.append(episode_spec(seed, self.outcome, chosen, self.objects))
        return specs

    @property
    def seeds(self) -> range:
        """Seeds that this outcome may use."""
        return range(self.first_seed, self.first_seed + _APART)


@dataclass(frozen=True)
class Recorded:
    """One recorded episode that came out as asked."""

    root: Path
    index: int
    purpose: str
    outcome: str
    object: str  # the one that was asked for
    scene: Scene


@checked_dataclass
class Sizes:
    """Numbers of episodes in each scene."""

    episodes: Count = 30
    """Judged episodes of each kind of failure."""
    suboptimal: Count = 30
    """Judged episodes of either poor success."""
    successes: Count = 100
    """Judged successes."""
    training: Count = 60
    """Successes of the training objects that fit units and value."""
    goals: Count = 3
    """Successes of each judged object whose ends are its goals."""
    calibration: Count = 30
    """Successes of the judged objects that set the success threshold."""


def plan(scene: Scene, sizes: Sizes) -> list[EpisodeBatch]:
    """Return everything that a scene needs."""
    part = SCENES.index(scene)
    training, goals, test = (
        range_.start + part * range_.count // 2  # a half of the seeds for each scene
        for range_ in (seeds.REWARD_TRAINING, seeds.REWARD_GOALS, seeds.REWARD_TEST)
    )
    held_out, n_goals = HELD_OUT_OBJECTS, sizes.goals * len(HELD_OUT_OBJECTS)
    counts = dict.fromkeys(KINDS, sizes.episodes) | dict.fromkeys(SUBOPTIMAL, sizes.suboptimal)
    return [
        EpisodeBatch("training", "success", sizes.training, TRAINING_OBJECTS, training),
        EpisodeBatch("goal", "success", n_goals, held_out, goals),
        EpisodeBatch("calibration", "success", sizes.calibration, held_out, goals + _APART),
        *(
            EpisodeBatch("test", o, counts.get(o, sizes.successes), held_out, test + k * _APART)
            for k, o in enumerate(OUTCOMES)
        ),
    ]


def record(
    folder: Path, scene: Scene, wanted: Sequence[EpisodeBatch], env: PickPlaceConfig, workers: int
) -> list[Recorded]:
    """Record what is missing in `folder`; return all that came out as asked.

    An episode that did not is drawn again with another seed, a few times.
    """
    for name, config, outcomes in _groups(env):
        chosen, root = [w for w in wanted if w.outcome in outcomes], folder / f"{scene}-{name}"
        for _ in range(_ATTEMPTS):
            done = _done(root)
            specs = [spec for w in chosen for spec in w.specs(scene, done)]
            if not specs:
                break
            collect(root, config, specs, workers)
    return list(_recorded(folder, scene, wanted, env))


def _groups(env: PickPlaceConfig) -> list[tuple[str, PickPlaceConfig, tuple[Outcome, ...]]]:
    """Return the sets that a scene needs: name, environment and outcomes of each."""
    wrong: tuple[Outcome, ...] = ("wrong_object",)
    usual: tuple[Outcome, ...] = tuple(o for o in OUTCOMES if o not in (*SUBOPTIMAL, *wrong))
    return [
        ("usual", env, usual),
        ("slow", replace(env, max_seconds=LONGEST_PLAN), SUBOPTIMAL),
        ("clutter", replace(env, distractors=1), wrong),
    ]


def _done(root: Path) -> dict[int, bool]:
    """Return for each recorded seed whether its episode came out as asked."""
    if not (root / INFO).exists():
        return {}
    episodes = EpisodeSet(root)
    metas = [episodes.meta(i) for i in range(len(episodes))]
    return {int(str(meta["seed"])): str(meta["outcome"]) in OUTCOMES for meta in metas}


def _recorded(
    folder: Path, scene: Scene, wanted: Sequence[EpisodeBatch], env: PickPlaceConfig
) -> Iterable[Recorded]:
    """Return the episodes that came out as asked, no more than wanted of each."""
    left = {w.first_seed: w.count for w in wanted}
    for name, _, _ in _groups(env):
        root = folder / f"{scene}-{name}"
        if not (root / INFO).exists():
            continue
        episodes = EpisodeSet(root)
        for i in range(len(episodes)):
            meta = episodes.meta(i)
            for w in wanted:
                mine = meta["seed"] in w.seeds and meta["outcome"] == w.outcome
                if mine and left[w.first_seed]:
                    left[w.first_seed] -= 1
                    yield Recorded(root, i, w.purpose, w.outcome, str(meta["asked"]), scene)

"""Runs of four hands for benchmark reward-judge, right ones and wrong ones, and the costs of their ends."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from benchmarks.papers.mixed_demonstrations import record_led, record_mixed
from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS, TRAINING_OBJECTS
from benchmarks.papers.reward_quality.recording import (
    KINDS,
    EpisodeBatch,
    Recorded,
    Sizes,
    plan,
    record,
)
from touchgoal.control.features import FRONT, Observation
from touchgoal.control.interfaces import Actor
from touchgoal.encoders import pretrained
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.recording import collect, missing_specs
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies import checkpoint
from touchgoal.policies.checkpoint import ESTIMATOR, SHIPPED_POLICIES, SavedPolicy
from touchgoal.policies.config import TrainConfig
from touchgoal.policies.evaluation.evaluate import trial_specs
from touchgoal.policies.training.improve import acts_alone
from touchgoal.policies.training.model_selection import copy_parts
from touchgoal.policies.training.sequence_dataset import SequenceDataset, load_recordings
from touchgoal.policies.training.train import POLICY, train
from touchgoal.rewards.distance.normalizer import NORMALIZER, DistanceNormalizer
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.embedding_cache import embed_end
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.judging.end_state import end_cost, end_costs
from touchgoal.rewards.reward import Reward
from touchgoal.rewards.sources.open_source import open_source
from touchgoal.rewards.value import Value
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig

_ENV = PickPlaceConfig(rest=1.0)
_GOALS = 3  # of each object
_EPOCHS = 16  # of the policy, learnt from the right ones of 80 demonstrations with other objects
_TAUGHT = 80
_OTHER_FAILURES = seeds.REWARD_TRAINING.start + 30_000
_POLICY_SEED = seeds.POLICY_TEST.start + 50_000
LETS_GO = "led hand"
"""The hand whose ends are others than those of the three that hold on."""


@dataclass(frozen=True)
class End:
    """The end of one run."""

    cost: float
    parts: dict[str, float]
    kind: str  # "success", or what went wrong
    object: str  # the one that was asked for


def record_hands(
    folder: Path, successes: int, failures: int, demonstrations: int, workers: int
) -> tuple[dict[str, list[End]], list[End]]:
    """Return the ends of each hand, and failures with other objects; what is recorded is kept."""
    sizes = Sizes(episodes=failures, suboptimal=1, successes=successes, training=1, goals=_GOALS)
    wanted = [w for w in plan("elsewhere", sizes) if w.purpose in ("goal", "test")]
    scripted = record(folder / "scripted", "elsewhere", wanted, _ENV, workers)
    goals = _ends_of([r for r in scripted if r.purpose == "goal"], workers)
    judged = [r for r in scripted if r.purpose == "test" and r.outcome not in ("slow", "regrasped")]
    feedback = record_mixed(folder / "feedback", demonstrations, _ENV, workers)
    led = record_led(folder / LETS_GO, demonstrations // 2, _ENV, workers)
    other = record_mixed(folder / "other", _TAUGHT, _ENV, workers, TRAINING_OBJECTS)
    policy = _policy_runs(folder / "policy", other, demonstrations // 2, workers)
    hands = {"scripted expert": judged, "feedback expert": feedback, LETS_GO: led, "policy": policy}
    found = {}
    for name, runs in hands.items():
        ends = (
            _ends_of([r for r in led if r.outcome == "success"], workers)
            if name == LETS_GO
            else goals
        )
        found[name] = _judge(runs, ends, workers)
    return found, _other_failures(folder, other, failures, workers)


def _other_failures(
    folder: Path, other: Sequence[Recorded], failures: int, workers: int
) -> list[End]:
    """Return ends of failures with the training objects, of the scripted and of the feedback expert."""
    count = max(1, failures // 2)
    wanted = [
        EpisodeBatch("test", kind, count, TRAINING_OBJECTS, _OTHER_FAILURES + 1000 * i)
        for i, kind in enumerate(KINDS)
    ]
    goal = EpisodeBatch("goal", "success", 20, TRAINING_OBJECTS, seeds.REWARD_TRAINING.start)
    scripted = record(folder / "other-scripted", "elsewhere", [goal, *wanted], _ENV, workers)
    ends = _ends_of([r for r in scripted if r.purpose == "goal"], workers)
    runs = [*(r for r in scripted if r.purpose == "test"), *other]
    return [e for e in _judge(runs, ends, workers) if e.kind != "success"]


def _ends_of(recorded: Sequence[Recorded], workers: int) -> SuccessfulEnds:
    return SuccessfulEnds.of(_embed(recorded, workers))


def _judge(recorded: Sequence[Recorded], ends: SuccessfulEnds, workers: int) -> list[End]:
    normalizer = DistanceNormalizer.load(pretrained.DEFAULT_ENCODER / NORMALIZER)
    value, found = Value.load(pretrained.DEFAULT_ENCODER), []
    for r, e in zip(recorded, _embed(recorded, workers), strict=True):
        try:
            goal = ends.for_trajectory(e, "ends of successes")
        except UserError:  # the only success with its object
            continue
        parts = end_costs(e.features, e.fps, goal, normalizer.unit, value)
        found.append(End(end_cost(parts), parts, r.outcome, r.object))
    return found


def _embed(recorded: Sequence[Recorded], workers: int) -> list[EmbeddedEpisode]:
    with parallel_map(_embed_one, recorded, workers) as results:
        return list(track(results, "embedding", "episode", total=len(recorded)))


def _embed_one(recorded: Recorded) -> EmbeddedEpisode:
    torch.set_num_threads(1)
    source = open_source(recorded.root, FRONT, [recorded.index])
    embedded = embed_end(_reward().embedder(source.inputs), source.trajectories[0])
    return replace(embedded, object=recorded.object)


@cache
def _reward() -> Reward:
    return Reward()


class _Unsure(Actor):
    """A policy that stands still where it is not sure of what it sees."""

    def __init__(self, policy: Actor, joints: int, width: float) -> None:
        self._policy, self._still = policy, np.append(np.zeros(joints), width)

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        try:
            action = self._policy.act(observation)
        except UserError:
            return self._still
        self._still[-1] = action[-1]
        return action


def _act(policy: Path, env: Any) -> Actor:
    """Return the policy in a folder for an environment after its reset."""
    return _Unsure(SavedPolicy(policy)(env), env.n_joints, env.width())


def _policy_runs(
    folder: Path, taught: Sequence[Recorded], count: int, workers: int
) -> list[Recorded]:
    shipped = SHIPPED_POLICIES["pick-place"]
    config, right = checkpoint.load(shipped).config, [r for r in taught if r.outcome == "success"]
    if not (folder / "training" / POLICY).exists():
        n = len(right) * 5 // 6
        sets = EpisodeSet(right[0].root)
        windows, validation = (
            SequenceDataset(load_recordings(sets, [r.index for r in some], config, None), config)
            for some in (right[:n], right[n:])
        )
        options = TrainConfig(epochs=_EPOCHS, lr=1e-3)
        train(config, windows, validation, options, folder / "training", TrainerOptions(seed=0), {})
    policy = folder / "training" / POLICY
    copy_parts(policy, {ESTIMATOR: shipped / ESTIMATOR})
    size = SavedPolicy(policy)().env_config(_ENV).camera_size
    env = replace(_ENV, objects=HELD_OUT_OBJECTS, camera_size=size)
    specs, root = trial_specs(env, count, _POLICY_SEED), folder / "episodes"
    if missing := missing_specs(root, specs):
        collect(root, env, missing, workers, partial(acts_alone, partial(_act, policy)))
    return list(_as_recorded(root))


def _as_recorded(root: Path) -> Iterable[Recorded]:
    episodes = EpisodeSet(root)
    for i in range(len(episodes)):
        meta = episodes.meta(i)
        kind = "success" if meta["success"] else "own failure"
        yield Recorded(root, i, "test", kind, str(meta["object"]), "elsewhere")

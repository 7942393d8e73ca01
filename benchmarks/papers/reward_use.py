"""Imitation of the demonstrations that a reward accepts.

Demonstrations are of mixed quality. Policies are regressions like the shipped pick-and-place policy.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.mixed_demonstrations import record_mixed, record_right
from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS
from benchmarks.papers.reward_quality.embedding import EmbeddedFiles
from benchmarks.papers.reward_quality.judging import Judge, fit_judge
from benchmarks.papers.reward_quality.recording import Recorded, Sizes, plan, record
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies import checkpoint
from touchgoal.policies.checkpoint import ESTIMATOR, SHIPPED_POLICIES, SavedPolicy
from touchgoal.policies.config import TrainConfig
from touchgoal.policies.evaluation.evaluate import Trial, run_trials, trial_specs
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.network import PolicyConfig
from touchgoal.policies.training.model_selection import copy_parts
from touchgoal.policies.training.sequence_dataset import (
    Recordings,
    SequenceDataset,
    load_recordings,
)
from touchgoal.policies.training.train import POLICY, train
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig

_ESTIMATOR = SHIPPED_POLICIES["pick-place"] / ESTIMATOR
_TASK = PickPlaceConfig(objects=HELD_OUT_OBJECTS)
_ACCEPTED = "accepted by "
_KEPT = 0.8  # share of right ones that a limit accepts
_NEARLY_ALL = ", 9 of 10"  # ends the names of rows whose limit accepts that share
Weights = Literal[
    "none", "successes alone", "2 of 3 successes", "accepted by judge", "accepted by judge, 9 of 10",
    "accepted by image", "accepted by tactile",
]  # fmt: skip
"""Weights of the demonstrations: none; 1 for successes, all or two of three, else 0; 1 where the end is no dearer
than four of five right ones, or nine of ten, else 0."""


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark reward-use."""

    quality: Path | None = None
    """Folder of a run of reward-quality, whose successes fit the reward; default: record them."""
    training: Count = 60
    """Successes of other objects that fit the reward's units and value."""
    goals: Count = 3
    """Successes of each object whose ends are the reward's goals."""
    demonstrations: Count = 240
    """Demonstrations, of which two fifths are right."""
    validation: Count = 16
    """Demonstrations without a mistake, to validate on."""
    encoder: str = "gelsight_mini"
    """Touch encoder, by name or folder."""
    every: Count = 4
    """Measure every n-th frame of the episodes only."""
    weights: tuple[Weights, ...] = get_args(Weights)
    """Rows to measure."""
    seeds: Count = 5
    """Trainings of each row, each with another seed."""
    trials: Count = 24
    """Simulated episodes of each policy."""
    train: TrainConfig = field(default_factory=lambda: TrainConfig(epochs=16, lr=1e-3))
    """Training of the policies."""
    env: PickPlaceConfig = PickPlaceConfig()
    """Environment of what is recorded."""
    workers: Count = CORES
    """Processes that simulate and embed."""


@dataclass(frozen=True, eq=False)
class _Demonstrations:
    """Episodes of mixed quality, and the windows of all of them."""

    recorded: list[Recorded]
    right: list[Recorded]
    recordings: Recordings
    validation: SequenceDataset  # other successes
    policy: PolicyConfig


def run(config: Config) -> dict[str, Any]:
    """Record what is missing, train and judge."""
    with tempfile.TemporaryDirectory() as folder:
        return _run(config, config.out or Path(folder))


def _run(config: Config, out: Path) -> dict[str, Any]:
    judge = _fitted(config, config.quality or out)
    judge = replace(judge, files=replace(judge.files, folder=out / "embedded"))
    mixed = record_mixed(out / "mixed", config.demonstrations, config.env, config.workers)
    right = record_right(out / "right", config.validation, config.env, config.workers)
    judge.files.make([*mixed, *right], config.workers)
    demonstrations = _read(mixed, right)
    rows = _imitate(demonstrations, judge, config)
    sizes = f"{len(mixed)} demonstrations, {sum(_good(mixed))} of them successes"
    table = _imitation_table(rows, sizes, config.trials)
    return {"table": table, "trials": config.trials, "imitation": rows}


def _fitted(config: Config, folder: Path) -> Judge:
    """Return a reward of other objects' successes, with the ends of these objects' as goals."""
    files = EmbeddedFiles(folder / "embedded", config.encoder, config.every)
    sizes = Sizes(training=config.training, goals=config.goals)
    wanted = [b for b in plan("elsewhere", sizes) if b.purpose in ("training", "goal")]
    recorded = record(folder / "episodes", "elsewhere", wanted, config.env, config.workers)
    files.make(recorded, config.workers)
    return fit_judge(files, recorded)


def _read(mixed: list[Recorded], right: list[Recorded]) -> _Demonstrations:
    policy = checkpoint.load(SHIPPED_POLICIES["pick-place"]).config
    validation = SequenceDataset(_recordings(right, policy), policy)
    return _Demonstrations(mixed, right, _recordings(mixed, policy), validation, policy)


def _recordings(chosen: list[Recorded], policy: PolicyConfig) -> Recordings:
    """Read states and actions of all episodes of one set."""
    return load_recordings(EpisodeSet(chosen[0].root), [r.index for r in chosen], policy, None)


def _good(recorded: Sequence[Recorded]) -> list[bool]:
    return [r.outcome == "success" for r in recorded]


def _weights(name: str, data: _Demonstrations, judge: Judge) -> np.ndarray | None:
    lengths = data.recordings.lengths
    if name == "none":
        return None
    if name == "successes alone":
        return np.repeat(_good(data.recorded), lengths).astype(np.float32)
    if name == "2 of 3 successes":
        good = np.array(_good(data.recorded))
        return np.repeat(good & (np.cumsum(good) % 3 > 0), lengths).astype(np.float32)
    kept = 0.9 if name.endswith(_NEARLY_ALL) else _KEPT
    curve = name.removeprefix(_ACCEPTED).removesuffix(_NEARLY_ALL)
    accepted = _accepted(judge, data, curve, kept)
    return np.repeat(accepted, lengths).astype(np.float32)


def _accepted(judge: Judge, data: _Demonstrations, curve: str, kept: float) -> list[bool]:
    """Return which episodes end no dearer than a share of right ones: by an end's cost, or a curve's."""

    def last(r: Recorded) -> float:
        if curve == "judge":
            return judge.end_cost(r)
        return float(judge.costs(judge.files.load(r), r.object)[curve][-1])

    right = [r for r, good in zip(data.right, _good(data.right), strict=True) if good]
    limit = np.quantile([last(r) for r in right], kept)
    return [last(r) <= limit for r in data.recorded]


@dataclass(frozen=True, eq=False)
class _Imitation:
    """One training of a row, and its trials, on one core."""

    data: _Demonstrations
    weights: dict[str, np.ndarray | None]
    config: Config

    def __call__(self, job: tuple[str, int]) -> dict[str, float]:
        """Return successes, mean progress and the share of the windows that are imitated."""
        name, seed = job
        weights, data, options = self.weights[name], self.data, TrainerOptions(seed=seed)
        with tempfile.TemporaryDirectory() as folder:
            windows = SequenceDataset(data.recordings, data.policy, weights)
            train(
                data.policy, windows, data.validation, self.config.train, Path(folder), options, {}
            )
            trials = _try(Path(folder) / POLICY, self.config.trials)
        return {
            "successes": float(sum(t.success for t in trials)),
            "progress": float(np.mean([t.progress for t in trials])),
            "used": 1.0 if weights is None else float((weights > 0).mean()),
        }


def _imitate(
    data: _Demonstrations, judge: Judge, config: Config
) -> dict[str, list[dict[str, float]]]:
    """Return what came of every seed, row by row."""
    weights = {name: _weights(name, data, judge) for name in config.weights}
    jobs = list(product(config.weights, range(config.seeds)))
    with parallel_map(_Imitation(data, weights, config), jobs, config.workers) as results:
        found = list(track(results, "imitation", "training", total=len(jobs)))
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in config.weights}
    for (name, _), result in zip(jobs, found, strict=True):
        rows[name].append(result)
    return rows


def _try(policy: Path, trials: int) -> list[Trial]:
    copy_parts(policy, {ESTIMATOR: _ESTIMATOR})
    maker = SavedPolicy(policy)
    env = maker().env_config(_TASK)
    specs = trial_specs(env, trials, seeds.POLICY_TEST.start)
    return list(run_trials(env, maker, specs, 1))


def _imitation_table(rows: dict[str, list[dict[str, float]]], sizes: str, trials: int) -> str:
    head = f"{'imitation weighted by':<28}{'windows used':>14}{'success [95 % Wilson]':>26}  of each seed"
    lines = [sizes, head]
    for name, found in rows.items():
        won = [int(f["successes"]) for f in found]
        rate = SuccessRate(sum(won), trials * len(won))
        lines.append(f"{name:<28}{found[0]['used']:>14.0%}{rate!s:>26}  {' '.join(map(str, won))}")
    return "\n".join(lines)

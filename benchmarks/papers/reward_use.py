"""Imitation weighted by the reward, and checkpoints ranked by it.

Demonstrations are of mixed quality. Policies are regressions like the shipped pick-and-place policy.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Float32
from pydantic import Field
from scipy.stats import spearmanr

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.mixed_demonstrations import record_mixed, record_right
from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS
from benchmarks.papers.reward_quality.embedding import EmbeddedFiles
from benchmarks.papers.reward_quality.judging import Judge, fit_judge
from benchmarks.papers.reward_quality.recording import Recorded, Sizes, plan, record
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.recording import collect
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies import checkpoint
from touchgoal.policies.checkpoint import (
    ESTIMATOR,
    POLICY_FORMAT,
    SHIPPED_POLICIES,
    SavedPolicy,
)
from touchgoal.policies.config import TrainConfig
from touchgoal.policies.evaluation.evaluate import Trial, run_trials, trial_specs
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.network import PolicyConfig
from touchgoal.policies.training.improve import Acting
from touchgoal.policies.training.model_selection import copy_parts
from touchgoal.policies.training.sequence_dataset import (
    Recordings,
    SequenceDataset,
    load_recordings,
)
from touchgoal.policies.training.train import POLICY, SNAPSHOTS, train
from touchgoal.rewards.curves import FUSED
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig

_ESTIMATOR = SHIPPED_POLICIES["pick-place"] / ESTIMATOR
_TASK = PickPlaceConfig(objects=HELD_OUT_OBJECTS)
ACCEPTED = "accepted by "
_KEPT = 0.8  # share of right ones that a limit accepts
_IN_FULL = 0.01  # progress above which a frame counts in full: kappa of RA-BC
_EPOCHS_APART = 2  # between two checkpoints that are ranked
Weights = Literal[
    "none",
    "successes alone",
    "fused",
    "image",
    "tactile",
    "accepted by judge",
    "accepted by image",
    "accepted by tactile",
]
"""Weights of the demonstrations: none; 1 for successes, 0 for others; those of `_progress_weights` by a
cost (RA-BC); 1 where the end is no dearer than
four of five right ones, else 0."""


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
    checkpoints: Annotated[int, Field(ge=0)] = 8
    """Checkpoints to rank, one every second epoch, of a training on the successes; 0: none."""
    rollouts: Count = 12
    """Episodes of each checkpoint that the reward judges."""
    seconds: Count = 1
    """Time in which a demonstration's progress is measured, s."""
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

    def windows(self, weights: np.ndarray | None) -> SequenceDataset:
        return SequenceDataset(self.recordings, self.policy, weights)


def run(config: Config) -> dict[str, Any]:
    """Record what is missing, train and judge."""
    if config.out is not None:
        return _run(config, config.out)
    with tempfile.TemporaryDirectory() as folder:
        return _run(config, Path(folder))


def _run(config: Config, out: Path) -> dict[str, Any]:
    judge = _fitted(config, config.quality or out)
    judge = replace(judge, files=replace(judge.files, folder=out / "embedded"))
    mixed = record_mixed(out / "mixed", config.demonstrations, config.env, config.workers)
    right = record_right(out / "right", config.validation, config.env, config.workers)
    judge.files.make([*mixed, *right], config.workers)
    demonstrations = _read(mixed, right)
    rows = _imitate(demonstrations, judge, config)
    ranked = _checkpoints(demonstrations, judge, config) if config.checkpoints else []
    sizes = f"{len(mixed)} demonstrations, {sum(_good(mixed))} of them successes"
    text = _imitation_table(rows, sizes, config.trials)
    if ranked:
        text += "\n\n" + _checkpoint_table(ranked)
    return {"table": text, "trials": config.trials, "imitation": rows, "checkpoints": ranked}


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


def _weights(name: str, data: _Demonstrations, judge: Judge, config: Config) -> np.ndarray | None:
    lengths = data.recordings.lengths
    if name == "none":
        return None
    if name == "successes alone":
        return np.repeat(_good(data.recorded), lengths).astype(np.float32)
    if name.startswith(ACCEPTED):
        accepted = _accepted(judge, data, name.removeprefix(ACCEPTED))
        return np.repeat(accepted, lengths).astype(np.float32)
    progress = [_progress(judge, r, name, n) for r, n in zip(data.recorded, lengths, strict=True)]
    return _progress_weights(progress, config.seconds * data.policy.control_hz)


def _progress_weights(
    progress: Sequence[Float[np.ndarray, " _"]], ahead: int
) -> Float32[np.ndarray, " n"]:
    """Return a weight in [0, 1] for every frame, by the progress of its episode in the next `ahead`.

    Reward-aligned behaviour cloning (RA-BC) of SARM (Chen et al. 2025, arXiv:2509.25358, eq. 8 and
    9), as lerobot computes it: frames with progress count in full, those that lose it not at all.
    """
    later = [np.minimum(np.arange(len(p)) + ahead, len(p) - 1) for p in progress]
    gain = np.concatenate([p[to] - p for p, to in zip(progress, later, strict=True)])
    mean, spread = max(gain.mean(), 0.0), max(gain.std(), 1e-6)
    weights = np.clip((gain - mean + 2 * spread) / (4 * spread), 0, 1)
    weights[gain > _IN_FULL] = 1
    weights[gain < 0] = 0
    weights[np.cumsum([len(p) for p in progress]) - 1] = 0  # no action follows the last frame
    return weights.astype(np.float32)


def _accepted(judge: Judge, data: _Demonstrations, curve: str) -> list[bool]:
    """Return which episodes end no dearer than four of five right ones: by an end's cost, or a curve's."""

    def last(r: Recorded) -> float:
        if curve == "judge":
            return judge.end_cost(r)
        return float(judge.costs(judge.files.load(r), r.object)[curve][-1])

    right = [r for r, good in zip(data.right, _good(data.right), strict=True) if good]
    limit = np.quantile([last(r) for r in right], _KEPT)
    return [last(r) <= limit for r in data.recorded]


def _progress(judge: Judge, r: Recorded, curve: str, length: int) -> Float[np.ndarray, " n"]:
    """Return the progress at every frame, between the measured ones by a straight line."""
    cost = judge.costs(judge.files.load(r), r.object)[curve]
    measured = np.arange((length - 1) % judge.files.every, length, judge.files.every)
    return np.clip(1 - np.interp(np.arange(length), measured, cost), 0, 1)


@dataclass(frozen=True, eq=False)
class _Imitation:
    """One training of a row, and its trials, on one core."""

    data: _Demonstrations
    weights: dict[str, np.ndarray | None]
    config: Config

    def __call__(self, job: tuple[str, int]) -> dict[str, float]:
        """Return successes, mean progress and the share of the windows that are imitated."""
        name, seed = job
        weights = self.weights[name]
        with tempfile.TemporaryDirectory() as folder:
            _train(self.data, self.data.windows(weights), self.config.train, Path(folder), seed)
            trials = _try(Path(folder) / POLICY, self.config.trials, 1)
        return {
            "successes": float(sum(t.success for t in trials)),
            "progress": float(np.mean([t.progress for t in trials])),
            "used": 1.0 if weights is None else float((weights > 0).mean()),
        }


def _imitate(
    data: _Demonstrations, judge: Judge, config: Config
) -> dict[str, list[dict[str, float]]]:
    """Return what came of every seed, row by row."""
    weights = {name: _weights(name, data, judge, config) for name in config.weights}
    jobs = list(product(config.weights, range(config.seeds)))
    with parallel_map(_Imitation(data, weights, config), jobs, config.workers) as results:
        found = list(track(results, "imitation", "training", total=len(jobs)))
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in config.weights}
    for (name, _), result in zip(jobs, found, strict=True):
        rows[name].append(result)
    return rows


def _train(
    data: _Demonstrations, windows: SequenceDataset, config: TrainConfig, out: Path, seed: int
) -> None:
    train(data.policy, windows, data.validation, config, out, TrainerOptions(seed=seed), {})


def _try(policy: Path, trials: int, workers: int) -> list[Trial]:
    copy_parts(policy, {ESTIMATOR: _ESTIMATOR})
    maker = SavedPolicy(policy)
    env = maker().env_config(_TASK)
    specs = trial_specs(env, trials, seeds.POLICY_TEST.start)
    return list(run_trials(env, maker, specs, workers))


def _checkpoints(data: _Demonstrations, judge: Judge, config: Config) -> list[dict[str, float]]:
    """Return success, mean last cost of each curve, and validation error of every checkpoint."""
    windows = data.windows(_weights("successes alone", data, judge, config))
    epochs = _EPOCHS_APART * config.checkpoints
    several = replace(config.train, epochs=epochs, snapshot_epochs=_EPOCHS_APART)
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _train(data, windows, several, folder, 0)
        for snapshot in track(sorted((folder / SNAPSHOTS).iterdir()), "checkpoints", "checkpoint"):
            trials = _try(snapshot, config.trials, config.workers)
            costs = _judge_rollouts(snapshot, judge, config, folder / f"rollouts-{snapshot.name}")
            known = POLICY_FORMAT.provenance(snapshot)["metrics"]
            found.append(
                {
                    "success": sum(t.success for t in trials) / len(trials),
                    "progress": float(np.mean([t.progress for t in trials])),
                    "validation_error": known["validation_error"],
                }
                | costs
            )
    return found


def _judge_rollouts(policy: Path, judge: Judge, config: Config, folder: Path) -> dict[str, float]:
    """Record episodes in which a checkpoint acts; return their mean last costs."""
    size = SavedPolicy(policy)().env_config(_TASK).camera_size
    env = replace(_TASK, cameras=("front", "wrist"), camera_size=size)
    specs = trial_specs(env, config.rollouts, seeds.POLICY_TEST.start + config.trials)
    collect(folder, env, specs, config.workers, Acting(SavedPolicy(policy)))
    episodes, files = EpisodeSet(folder), replace(judge.files, folder=folder / "embedded")
    recorded = [
        Recorded(folder, i, "test", "", str(episodes.meta(i)["object"]), "elsewhere")
        for i in range(len(episodes))
    ]
    files.make(recorded, config.workers)
    last = [
        {k: float(c[-1]) for k, c in judge.costs(files.load(r), r.object).items()} for r in recorded
    ]
    return {
        f"cost, {k}": float(np.mean([costs[k] for costs in last]))
        for k in (FUSED, "image", "tactile")
    }


def _imitation_table(rows: dict[str, list[dict[str, float]]], sizes: str, trials: int) -> str:
    head = f"{'imitation weighted by':<24}{'windows used':>14}{'success [95 % Wilson]':>26}  of each seed"
    lines = [sizes, head]
    for name, found in rows.items():
        won = [int(f["successes"]) for f in found]
        rate = SuccessRate(sum(won), trials * len(won))
        lines.append(f"{name:<24}{found[0]['used']:>14.0%}{rate!s:>26}  {' '.join(map(str, won))}")
    return "\n".join(lines)


def _checkpoint_table(ranked: list[dict[str, float]]) -> str:
    names = list(ranked[0])
    lines = ["checkpoint" + "".join(f"{n:>18}" for n in names)]
    for i, row in enumerate(ranked, 1):
        lines.append(f"epoch {_EPOCHS_APART * i:<4}" + "".join(f"{row[n]:>18.3f}" for n in names))
    success = [row["success"] for row in ranked]
    of = [spearmanr(success, [row[n] for row in ranked])[0] for n in names]
    lines.append("rank corr." + "".join(f"{r:>18.2f}" for r in of))
    return "\n".join(lines)

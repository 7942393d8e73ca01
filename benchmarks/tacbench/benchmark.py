"""TacBench (Sparsh, Higuera et al. 2024) on a simulated bench: T1, force; T2, slip; T3, pose.

An attentive probe reads each encoder's tokens of two frames 83 ms apart; encoders stay frozen, or are
trained end to end with the probe from random weights. Labels are thinned to shares of all. Snapshots
and thresholds are chosen on validation strokes; test strokes are for the table alone. Intervals are a
bootstrap over test strokes, of the mean over seeds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from touchgoal.benchmarks.config import TacbenchOptions
from touchgoal.benchmarks.tacbench.data import RigFrames, Rows, read_strokes
from touchgoal.benchmarks.tacbench.figures import Read, draw
from touchgoal.benchmarks.tacbench.probes import (
    END_TO_END,
    Inputs,
    PairTokens,
    ProbeTraining,
    Reader,
    find_encoder_of,
    frozen_tokens,
    read,
    train_reader,
)
from touchgoal.benchmarks.tacbench.tables import table
from touchgoal.benchmarks.tacbench.tasks import (
    CLASSES,
    TASKS,
    ForceTask,
    PoseTask,
    SlipTask,
    Task,
    f1_score,
)
from touchgoal.control.errors import UserError
from touchgoal.control.interruption import kept
from touchgoal.control.progress import Progress
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder
from touchgoal.encoders.probes.property_probe import interval
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.stroke_recording import record_slides, record_strokes
from touchgoal.sim_envs.indenter_rig import FRICTION

_LEAST_SAMPLES = 8
_LOG = "training.log"
_RECORDING = {"force": "strokes", "slip": "strokes", "pose": "slides"}


@dataclass(frozen=True, eq=False)
class Subject:
    """One encoder of the table.

    Attributes:
        name: as the user gave it.
        encoder: the frozen one; of one trained end to end only its kind counts.
        frames: of the rig, as its preprocessor makes them.
        inputs_of: rows of the frames to what a reader reads.
        trained: whether it is trained with each probe.
    """

    name: str
    encoder: BaseTouchEncoder
    frames: RigFrames
    inputs_of: Callable[[Rows], Inputs]
    trained: bool


@dataclass(frozen=True)
class Scored:
    """Predictions of the seeds of one row of the table, on one set of test frames."""

    outputs: list[torch.Tensor]
    thresholds: list[float]


def run(config: TacbenchOptions) -> dict[str, Any]:
    """Record strokes, train every probe, judge it on test strokes."""
    encoders = {name: _encoder(name, config) for name in config.encoders}
    sensor = Path(config.rig.sensor).name  # of a sensor file's folder, too
    folder = config.data or Path("runs") / f"tacbench_{sensor}_{config.rig.seed}"
    recordings: dict[str, EpisodeSet] = {}
    for what in dict.fromkeys(_RECORDING[task] for task in config.tasks):
        record, count = _recorder(what, config)
        recordings[what] = record(folder / what, config.rig, count, config.workers)
    rows: list[dict[str, Any]] = []
    reads: list[Read] = []
    trainings = len(encoders) * len(config.tasks) * len(config.shares) * config.seeds
    with (
        kept(lambda: f"strokes are kept in {folder}, trained probes are not"),
        (folder / _LOG).open("a") as log,
        Progress("probes", trainings, "training") as bar,
    ):
        for what, episodes in recordings.items():
            tasks = [task for task in config.tasks if _RECORDING[task] == what]
            count = _recorder(what, config)[1]
            seen: dict[str, RigFrames] = {}
            for name, encoder in encoders.items():
                preprocess = encoder.preprocess
                if preprocess.id not in seen:
                    seen[preprocess.id] = read_strokes(episodes, count, preprocess)
                subject = _subject(name, encoder, seen[preprocess.id])
                for task, share in product(tasks, config.shares):
                    judged = _train_and_judge(subject, task, share, config, log, bar)
                    rows += judged[0]
                    reads += judged[1]
            frames = next(iter(seen.values()))
            for task in tasks:
                rows += _references(TASKS[task](frames), task, frames)
    return {
        "table": table(rows, find_sensor(config.rig.sensor).name, config),
        "rows": rows,
        "picture": draw(reads),
    }


def _recorder(what: str, config: TacbenchOptions) -> tuple[Callable[..., EpisodeSet], int]:
    """By what strokes or slides are recorded, and how many."""
    if what == "strokes":
        return record_strokes, config.strokes
    return record_slides, config.slides


def _encoder(name: str, config: TacbenchOptions) -> BaseTouchEncoder:
    """An encoder that fits the rig's sensor; UserError for another."""
    encoder = find_encoder_of(name, config.seed)
    PairTokens(encoder)  # refuses one without tokens
    sensor = find_sensor(config.rig.sensor).name
    if encoder.preprocess.sensor not in (None, sensor):
        raise UserError(
            f"the encoder {name} is for {encoder.preprocess.sensor}, the rig has {sensor}: choose "
            "--rig.sensor or --encoders"
        )
    return encoder


def _subject(name: str, encoder: BaseTouchEncoder, frames: RigFrames) -> Subject:
    """An encoder with what its probes read; only a frozen one's tokens are known beforehand."""
    if name.startswith(END_TO_END):
        offsets = PairTokens(encoder).offsets
        return Subject(name, encoder, frames, partial(frames.seen, offsets=offsets), True)
    return Subject(name, encoder, frames, frozen_tokens(encoder, frames), False)


def _train_and_judge(
    subject: Subject,
    task_name: str,
    share: float,
    config: TacbenchOptions,
    log: TextIO,
    bar: Progress,
) -> tuple[list[dict[str, Any]], list[Read]]:
    """The rows of one encoder, task and share, one for each set of test frames."""
    task = TASKS[task_name](subject.frames)
    count = max(round(share * len(task.split.train)), _LEAST_SAMPLES)
    scored = {test: Scored([], []) for test in task.split.tests}
    trained = subject.trained
    for seed in range(config.seed, config.seed + config.seeds):
        reader = _reader(subject, task, seed)
        training = ProbeTraining(
            config.end_to_end_steps if trained else config.steps,
            config.batch_size,
            config.end_to_end_lr if trained else config.lr,
            seed,
        )
        train = _thinned(task.split.train, count, seed)
        train_reader(reader, task, subject.inputs_of, train, training, log)
        _score(task, reader, subject.inputs_of, scored)
        bar.update()
    rows, reads = [], []
    for test, results in scored.items():
        chosen = task.split.tests[test]
        facts = {"task": task_name, "encoder": subject.name, "test": test}
        facts |= {"share": share, "samples": count, "test_samples": len(chosen)}
        rows.append(facts | _judge(task, results, chosen, subject.frames))
        outputs = results.outputs[0]
        reads.append(Read(task, subject.frames, subject.name, share, test, chosen, outputs))
    return rows, reads


def _reader(subject: Subject, task: Task, seed: int) -> Reader:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoder = find_encoder_of(subject.name, seed) if subject.trained else subject.encoder
        tokens = PairTokens(encoder)
        return Reader(task, tokens.features, tokens if subject.trained else None)


def _thinned(rows: Rows, count: int, seed: int) -> Rows:
    """So many rows, drawn at random; of one seed fewer rows are part of more."""
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
    return rows[order[:count]]


def _score(
    task: Task,
    reader: Reader,
    inputs_of: Callable[[Rows], Inputs],
    scored: dict[str, Scored],
) -> None:
    threshold = 0.0
    if isinstance(task, SlipTask):
        validation = task.split.validation
        threshold = task.threshold(read(reader, inputs_of, validation), validation)
    for test, results in scored.items():
        results.outputs.append(read(reader, inputs_of, task.split.tests[test]))
        results.thresholds.append(threshold)


def _judge(task: Task, scored: Scored, rows: Rows, frames: RigFrames) -> dict[str, Any]:
    things = frames.stroke[rows.numpy()]
    if isinstance(task, ForceTask):
        return force_metrics(np.stack([task.errors(o, rows) for o in scored.outputs]), things)
    if isinstance(task, PoseTask):
        said = np.stack([task.read(outputs).numpy() for outputs in scored.outputs])
        return pose_metrics(said, task.classes[rows].numpy(), things)
    assert isinstance(task, SlipTask)
    pairs = zip(scored.outputs, scored.thresholds, strict=True)
    said = np.stack([o[:, 0].numpy() > t for o, t in pairs])
    changes = np.mean([task.change_error(o, rows) for o in scored.outputs], 0)
    metrics = slip_metrics(said, task.truth(rows), things)
    return metrics | {"change_mae_mn": 1e3 * float(changes.mean()), "thresholds": scored.thresholds}


def force_metrics(
    errors: Float[np.ndarray, "seeds n 3"], things: np.ndarray
) -> dict[str, float | list[float]]:
    """Root mean square and mean absolute errors (mN): of each axis and of all, with intervals."""
    squares, sizes = 1e6 * (errors**2).mean(0), 1e3 * np.abs(errors).mean(0)

    def root(values: np.ndarray) -> float:
        return float(np.sqrt(values.mean()))

    return {
        "rmse_mn": root(squares),
        "rmse_mn_interval": list(interval(squares, things, root)),
        "mae_mn": float(sizes.mean()),
        "mae_mn_interval": list(interval(sizes, things)),
        "rmse_mn_by_axis": np.sqrt(squares.mean(0)).tolist(),
        "mae_mn_by_axis": sizes.mean(0).tolist(),
    }


def slip_metrics(
    said: Bool[np.ndarray, "seeds n"], truth: Bool[np.ndarray, " n"], things: np.ndarray
) -> dict[str, float | list[float]]:
    """F1 of slipping, the mean over seeds, with its interval."""
    together = np.vstack([truth, said]).T

    def f1(values: np.ndarray) -> float:
        return float(np.mean([f1_score(column, values[:, 0]) for column in values.T[1:]]))

    return {"f1": f1(together), "f1_interval": list(interval(together, things, f1))}


def pose_metrics(
    said: Int[np.ndarray, "seeds n 3"], truth: Int[np.ndarray, "n 3"], things: np.ndarray
) -> dict[str, float | list[float]]:
    """Accuracy, the mean over axes, with its interval; by axis; and within one class of the truth."""
    right = (said == truth).mean(0)
    return {
        "accuracy": float(right.mean()),
        "accuracy_interval": list(interval(right, things)),
        "accuracy_by_axis": right.mean(0).tolist(),
        "within_one_class": float((np.abs(said - truth) <= 1).mean()),
    }


def _references(task: Task, name: str, frames: RigFrames) -> list[dict[str, Any]]:
    """What needs no encoder: the mean force; slip always, and by the nominal friction cone; common classes."""
    rows = []
    for test, chosen in task.split.tests.items():
        things, force = frames.stroke[chosen.numpy()], frames.force[chosen].double().numpy()
        facts = {
            "task": name,
            "test": test,
            "share": 1.0,
            "samples": 0,
            "test_samples": len(chosen),
        }
        if isinstance(task, ForceTask):
            mean = frames.force[task.split.train].mean(0).double().numpy()
            metrics = force_metrics((mean - force)[None], things)
            rows.append(facts | {"encoder": "(mean force of training)"} | metrics)
            continue
        if isinstance(task, PoseTask):
            known = task.classes[task.split.train]
            common = [
                int(torch.bincount(known[:, k], minlength=CLASSES).argmax()) for k in range(3)
            ]
            truth = task.classes[chosen].numpy()
            metrics = pose_metrics(np.broadcast_to(common, truth.shape)[None], truth, things)
            rows.append(facts | {"encoder": "(commonest classes)"} | metrics)
            continue
        assert isinstance(task, SlipTask)
        cone = np.hypot(force[:, 0], force[:, 1]) >= FRICTION * force[:, 2]
        for reference, said in (
            ("(always slips)", np.ones(len(chosen), bool)),
            ("(true forces, nominal cone)", cone),
        ):
            metrics = slip_metrics(said[None], task.truth(chosen), things)
            rows.append(facts | {"encoder": reference} | metrics)
    return rows

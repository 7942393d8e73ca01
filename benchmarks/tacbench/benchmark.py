"""TacBench (Sparsh, Higuera et al. 2024) on a simulated bench: T1, T1A, T2, T3, T4 and T6.

A probe reads each encoder's tokens of two frames 83 ms apart; encoders stay frozen, or are
trained end to end with the probe from random weights. Labels are thinned to shares of all. Snapshots
and thresholds are chosen on validation recordings; test recordings are for the table alone. Intervals are a
bootstrap over test recordings, of the mean over seeds.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import torch

from touchgoal.benchmarks.config import TacbenchOptions
from touchgoal.benchmarks.tacbench.data import (
    RigFrames,
    Rows,
    read_cloths,
    read_grasps,
    read_strokes,
    with_fields,
)
from touchgoal.benchmarks.tacbench.figures import Read, pictures
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
from touchgoal.benchmarks.tacbench.published_recordings import check_tasks, find_published
from touchgoal.benchmarks.tacbench.tables import table
from touchgoal.benchmarks.tacbench.task import Task
from touchgoal.benchmarks.tacbench.tasks import RECORDED_AS, TASKS, Recording
from touchgoal.control.errors import UserError
from touchgoal.control.interruption import kept
from touchgoal.control.progress import Progress
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder
from touchgoal.encoders.preprocess import Preprocessor
from touchgoal.episodes.bench_recording import (
    record_cloths,
    record_grasps,
    record_slides,
    record_strokes,
)
from touchgoal.episodes.store import EpisodeSet

_LEAST_SAMPLES = 8
_LOG = "training.log"
_RECORDERS: dict[Recording, Callable[..., EpisodeSet]] = {
    "strokes": record_strokes,
    "slides": record_slides,
    "grasps": record_grasps,
    "cloths": record_cloths,
}
_READERS: dict[Recording, Callable[[EpisodeSet, int, Preprocessor], RigFrames]] = {
    "strokes": read_strokes,
    "slides": read_strokes,
    "grasps": read_grasps,
    "cloths": read_cloths,
}
Reading = Callable[[Preprocessor], RigFrames]
"""Recordings, as an encoder's preprocessor makes them."""


@dataclass(frozen=True, eq=False)
class Subject:
    """One encoder of the table.

    Attributes:
        name: as the user gave it.
        encoder: the frozen one; of one trained end to end only its kind counts.
        frames: of the bench, as its preprocessor makes them.
        inputs_of: rows of the frames to what a reader reads.
        trained: whether it is trained with each probe.
    """

    name: str
    encoder: BaseTouchEncoder
    frames: RigFrames
    inputs_of: Callable[[Rows], Inputs]
    trained: bool


@dataclass(frozen=True)
class Bench:
    """What all trainings share."""

    config: TacbenchOptions
    sensor: str
    log: TextIO
    bar: Progress
    rows: list[dict[str, Any]]
    reads: list[Read]


def run(config: TacbenchOptions) -> dict[str, Any]:
    """Record the bench, train every probe, judge it on test recordings."""
    sensor = find_sensor(config.rig.sensor).name
    published = find_published(config.data, sensor) if config.data else None
    if published is not None and config.data is not None:
        check_tasks(published, config.data, config.tasks)
        sensor = published.sensor
    encoders = {name: _encoder(name, sensor, config) for name in config.encoders}
    short = Path(config.rig.sensor).name  # of a sensor file's folder, too
    folder = Path("runs") / f"tacbench_{short}_{config.rig.seed}"
    readings: dict[Recording, Reading]
    if published is None:
        folder = config.data or folder
        readings = {what: _record(what, folder, config) for what in _recordings(config)}
    else:
        folder.mkdir(parents=True, exist_ok=True)
        readings = {published.what: partial(published.read, getattr(config, published.what))}
    trainings = len(encoders) * len(config.tasks) * len(config.shares) * config.seeds
    with (
        kept(lambda: f"recordings are kept in {config.data or folder}, trained probes are not"),
        (folder / _LOG).open("a") as log,
        Progress("probes", trainings, "training") as bar,
    ):
        bench = Bench(config, sensor, log, bar, [], [])
        for what, reading in readings.items():
            _run_recording(bench, what, reading, encoders)
    bench.rows.sort(key=lambda row: config.tasks.index(row["task"]))
    return {
        "table": table(bench.rows, sensor, config, config.data if published else None),
        "rows": bench.rows,
        "pictures": pictures(bench.rows, bench.reads, sensor),
    }


def _recordings(config: TacbenchOptions) -> list[Recording]:
    return list(dict.fromkeys(RECORDED_AS[task] for task in config.tasks))


def _record(what: Recording, folder: Path, config: TacbenchOptions) -> Reading:
    """Records what is missing of the bench's recordings."""
    count = getattr(config, what)
    episodes = _RECORDERS[what](folder / what, config.rig, count, config.workers)
    return partial(_READERS[what], episodes, count)


def _encoder(name: str, sensor: str, config: TacbenchOptions) -> BaseTouchEncoder:
    """An encoder that fits the rig's sensor; UserError for another."""
    encoder = find_encoder_of(name, sensor, config.seed)
    PairTokens(encoder)  # refuses one without tokens
    if encoder.preprocess.sensor not in (None, sensor):
        raise UserError(
            f"the encoder {name} is for {encoder.preprocess.sensor}, the rig has {sensor}: choose "
            "--rig.sensor or --encoders"
        )
    return encoder


def _run_recording(
    bench: Bench, what: Recording, reading: Reading, encoders: dict[str, BaseTouchEncoder]
) -> None:
    """All tasks on one kind of recordings; frames and tokens are kept no longer than for these."""
    config = bench.config
    tasks = [name for name in config.tasks if RECORDED_AS[name] == what]
    seen: dict[str, RigFrames] = {}
    for name, encoder in encoders.items():
        key = encoder.preprocess.id
        if key not in seen:
            frames = reading(encoder.preprocess)
            if "field" in tasks:
                frames = with_fields(frames, config.rig, config.workers)
            seen[key] = frames
        subject = _subject(name, encoder, seen[key])
        for task_name in tasks:
            task = TASKS[task_name](subject.frames)
            for share in config.shares:
                _train_and_judge(bench, subject, task_name, task, share)
    frames = next(iter(seen.values()))
    for task_name in tasks:
        bench.rows.extend(_references(task_name, TASKS[task_name](frames)))


def _subject(name: str, encoder: BaseTouchEncoder, frames: RigFrames) -> Subject:
    """An encoder with what its probes read; only a frozen one's tokens are known beforehand."""
    if name.startswith(END_TO_END):
        offsets = PairTokens(encoder).offsets
        return Subject(name, encoder, frames, partial(frames.seen, offsets=offsets), True)
    return Subject(name, encoder, frames, frozen_tokens(encoder, frames), False)


def _train_and_judge(
    bench: Bench, subject: Subject, task_name: str, task: Task, share: float
) -> None:
    """The rows of one encoder, task and share, one for each set of test frames."""
    config, began = bench.config, time.monotonic()
    count = max(round(share * len(task.split.train)), _LEAST_SAMPLES)
    tests = task.split.tests
    said: dict[str, list[torch.Tensor]] = {test: [] for test in tests}
    validation: list[torch.Tensor] = []
    for seed in range(config.seed, config.seed + config.seeds):
        reader = _reader(subject, task, bench.sensor, seed)
        train = _thinned(task.split.train, count, seed)
        training = _training(config, subject.trained, seed)
        train_reader(reader, task, subject.inputs_of, train, training, bench.log)
        validation.append(read(reader, subject.inputs_of, task.split.validation))
        for test, rows in tests.items():
            said[test].append(read(reader, subject.inputs_of, rows))
        bench.bar.update()
    facts = {"task": task_name, "encoder": subject.name, "share": share, "samples": count}
    facts["seconds"] = round((time.monotonic() - began) / config.seeds, 1)
    for test, rows in tests.items():
        about = facts | {"test": test, "test_samples": len(rows)}
        bench.rows.append(about | task.judge(said[test], validation, rows))
        bench.reads.append(
            Read(task_name, task, subject.frames, subject.name, share, test, rows, said[test][0])
        )


def _training(config: TacbenchOptions, trained: bool, seed: int) -> ProbeTraining:
    if trained:
        steps, size, lr = (
            config.end_to_end_steps,
            config.end_to_end_batch_size,
            config.end_to_end_lr,
        )
    else:
        steps, size, lr = config.steps, config.batch_size, config.lr
    return ProbeTraining(steps, size, lr, seed)


def _reader(subject: Subject, task: Task, sensor: str, seed: int) -> Reader:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoder = subject.encoder
        if subject.trained:
            encoder = find_encoder_of(subject.name, sensor, seed)
        return Reader(task, PairTokens(encoder), subject.trained)


def _thinned(rows: Rows, count: int, seed: int) -> Rows:
    """So many rows, drawn at random; of one seed fewer rows are part of more."""
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
    return rows[order[:count]]


def _references(name: str, task: Task) -> list[dict[str, Any]]:
    """Rows of what needs no encoder."""
    rows = []
    for test, chosen in task.split.tests.items():
        facts = {"task": name, "test": test, "share": 1.0, "samples": 0}
        facts["test_samples"] = len(chosen)
        for reference, metrics in task.references(chosen).items():
            rows.append(facts | {"encoder": reference} | metrics)
    return rows

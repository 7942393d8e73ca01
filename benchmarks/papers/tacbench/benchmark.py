"""TacBench (Sparsh, Higuera et al. 2024) on a simulated bench: T1, T1A, T2, T3, T4 and T6.

A probe reads each encoder's tokens of two frames 83 ms apart. Snapshots and thresholds are chosen on
validation recordings; intervals are a bootstrap over test recordings of the mean over seeds.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import torch

from benchmarks.papers.tacbench import data, probes
from benchmarks.papers.tacbench.config import RECORDED_AS, Config, Recording
from benchmarks.papers.tacbench.task import Task
from benchmarks.papers.tacbench.trainings import TASKS, Job, Subject, work
from benchmarks.papers.tacbench_report.figures import draw_by_labels
from benchmarks.papers.tacbench_report.tables import table
from benchmarks.papers.tacbench_rig.recording import record_bench
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder
from touchgoal.encoders.preprocess import Preprocessor
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.interruption import on_interruption
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track

_READERS: dict[Recording, Callable[[EpisodeSet, int, Preprocessor], data.RigFrames]] = {
    "strokes": data.read_strokes,
    "slides": data.read_strokes,
    "grasps": data.read_grasps,
    "cloths": data.read_cloths,
}
Reading = Callable[[Preprocessor], data.RigFrames]
"""Reads the recordings with an encoder's preprocessor."""


@dataclass(frozen=True)
class Bench:
    """Arguments that all trainings share."""

    config: Config
    sensor: str
    folder: Path
    encoders: dict[str, BaseTouchEncoder]


def run(config: Config) -> dict[str, Any]:
    """Record the bench, train every probe and judge it on test recordings."""
    sensor = find_sensor(config.rig.sensor).name
    encoders = {name: _encoder(name, sensor, config) for name in config.encoders}
    short = Path(config.rig.sensor).name  # also the name of a sensor file's folder
    folder = config.data or Path("runs") / f"tacbench_{short}_{config.rig.seed}"
    recordings: dict[Recording, None] = dict.fromkeys(RECORDED_AS[t] for t in config.tasks)
    readings: dict[Recording, Reading] = {w: _record(w, folder, config) for w in recordings}
    bench = Bench(config, sensor, folder, encoders)
    kept = f"recordings are in {folder}; probes are not saved"
    with on_interruption(lambda: kept):
        rows = [row for what, how in readings.items() for row in _run_recording(bench, what, how)]
    rows.sort(key=lambda row: config.tasks.index(row["task"]))
    return {
        "table": table(rows, sensor, config),
        "rows": rows,
        "pictures": {"by_labels": draw_by_labels(rows, sensor)},
    }


def _record(what: Recording, folder: Path, config: Config) -> Reading:
    count = getattr(config, what)
    episodes = record_bench(what, folder / what, config.rig, count, config.workers)
    return partial(_READERS[what], episodes, count)


def _encoder(name: str, sensor: str, config: Config) -> BaseTouchEncoder:
    """Return an encoder of the rig's sensor; UserError for another sensor."""
    encoder = probes.find_encoder_of(name, sensor, config.seed)
    probes.PairTokens(encoder)  # refuses one without tokens
    if encoder.preprocess.sensor not in (None, sensor):
        raise UserError(
            f"the encoder {name} is for {encoder.preprocess.sensor}, the rig has {sensor}: choose "
            "--rig.sensor or --encoders"
        )
    return encoder


def _run_recording(bench: Bench, what: Recording, reading: Reading) -> list[dict[str, Any]]:
    """Run all tasks on one kind of recordings; frames and tokens are freed afterwards."""
    tasks = [name for name in bench.config.tasks if RECORDED_AS[name] == what]
    with tempfile.TemporaryDirectory(dir=bench.folder) as files:
        subjects, frames = _share(bench, tasks, reading, Path(files))
        jobs = [
            Job(subject, task, share, bench.config, bench.folder / "training.log")
            for subject in subjects
            for task in tasks
            for share in bench.config.shares
        ]
        with parallel_map(work, jobs, bench.config.workers) as judged:
            counted = track(judged, "probes", "probe", total=len(jobs))
            rows = list(chain.from_iterable(counted))
    for name in tasks:
        rows += _references(name, TASKS[name](frames))
    return rows


def _share(
    bench: Bench, tasks: list[str], reading: Reading, files: Path
) -> tuple[list[Subject], data.RigFrames]:
    """Write each encoder's frames and tokens into files for the workers; return the first frames."""
    shared_frames: dict[str, tuple[Path, data.RigFrames]] = {}
    subjects = []
    for i, (name, encoder) in enumerate(bench.encoders.items()):
        key = encoder.preprocess.id
        if key not in shared_frames:
            frames = reading(encoder.preprocess)
            if "field" in tasks:
                frames = data.with_fields(frames, bench.config.rig, bench.config.workers)
            shared_frames[key] = files / f"frames_{i}.pt", frames
            torch.save(frames, shared_frames[key][0])
        path, frames = shared_frames[key]
        tokens = None
        if not name.startswith(probes.END_TO_END):
            tokens = files / f"tokens_{i}.pt"
            torch.save(probes.frozen_tokens(encoder, frames), tokens)
        subjects.append(Subject(name, bench.sensor, path, tokens))
    return subjects, next(iter(shared_frames.values()))[1]


def _references(name: str, task: Task) -> list[dict[str, Any]]:
    rows = []
    for test, chosen in task.split.tests.items():
        facts = {"task": name, "test": test, "share": 1.0, "samples": 0}
        facts["test_samples"] = len(chosen)
        for reference, metrics in task.references(chosen).items():
            rows.append(facts | {"encoder": reference} | metrics)
    return rows

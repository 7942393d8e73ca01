"""Trainings of probes on workers; frames and tokens lie in mapped files."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.papers.tacbench import probes
from benchmarks.papers.tacbench.config import Config
from benchmarks.papers.tacbench.data import RigFrames, Rows
from benchmarks.papers.tacbench.force import FieldTask, ForceTask
from benchmarks.papers.tacbench.labels import grasp_task, textile_task
from benchmarks.papers.tacbench.pose import PoseTask
from benchmarks.papers.tacbench.slip import SlipTask
from benchmarks.papers.tacbench.task import Task, thinned
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder

TASKS: dict[str, Callable[[RigFrames], Task]] = {
    "force": ForceTask,
    "field": FieldTask,
    "slip": SlipTask,
    "pose": PoseTask,
    "grasp": grasp_task,
    "textile": textile_task,
}
_LEAST_SAMPLES = 8


@dataclass(frozen=True)
class Subject:
    """One encoder, as the user named it, on one kind of recordings."""

    name: str
    sensor: str
    frames: Path  # file of `RigFrames` from the encoder's preprocessor
    tokens: Path | None  # file of a frozen encoder's tokens; None for one that is trained


@dataclass(frozen=True)
class Job:
    """One encoder, task and share of the training labels, all seeds."""

    subject: Subject
    task: str
    share: float
    config: Config
    log: Path  # for the trainer's lines


def work(job: Job) -> list[dict[str, Any]]:
    """Train a job's probes, one a seed, and judge them on each test set; on one core."""
    torch.set_num_threads(1)
    config, subject, began = job.config, job.subject, time.monotonic()
    frames = _mapped(subject.frames)
    task = TASKS[job.task](frames)
    encoder = _encoder(subject.name, subject.sensor, config.seed)
    inputs_of = _inputs_of(subject, encoder, frames)
    count = max(round(job.share * len(task.split.train)), _LEAST_SAMPLES)
    readers, scratch = [], subject.frames.parent
    for seed in range(config.seed, config.seed + config.seeds):
        reader = _reader(subject, encoder, task, seed)
        train = thinned(task.split.train, count, seed)
        with job.log.open("a") as log:
            probes.train_reader(reader, task, inputs_of, train, config, seed, scratch, log)
        readers.append(reader)
    seconds = round((time.monotonic() - began) / config.seeds, 1)
    facts = {"task": job.task, "encoder": subject.name, "share": job.share, "samples": count}
    validation = [probes.read(reader, inputs_of, task.split.validation) for reader in readers]
    rows = []
    for test, chosen in task.split.tests.items():
        about = facts | {"seconds": seconds, "test": test, "test_samples": len(chosen)}
        predicted = [probes.read(reader, inputs_of, chosen) for reader in readers]
        rows.append(about | task.judge(predicted, validation, chosen))
    return rows


@lru_cache(maxsize=2)
def _mapped(path: Path) -> RigFrames:
    return torch.load(path, mmap=True, weights_only=False)  # written by this run


@lru_cache(maxsize=1)
def _encoder(name: str, sensor: str, seed: int) -> BaseTouchEncoder:
    return probes.find_encoder_of(name, sensor, seed)


def _inputs_of(
    subject: Subject, encoder: BaseTouchEncoder, frames: RigFrames
) -> Callable[[Rows], probes.Inputs]:
    pairs = probes.PairTokens(encoder)
    if subject.tokens is None:
        return partial(frames.stacked, offsets=pairs.offsets)
    return probes.inputs_of_tokens(pairs, torch.load(subject.tokens, mmap=True), frames)


def _reader(subject: Subject, encoder: BaseTouchEncoder, task: Task, seed: int) -> probes.Reader:
    """Return a probe with random weights, with an encoder if that is trained."""
    trained = subject.tokens is None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if trained:
            encoder = probes.find_encoder_of(subject.name, subject.sensor, seed)
        return probes.Reader(task, probes.PairTokens(encoder), trained)

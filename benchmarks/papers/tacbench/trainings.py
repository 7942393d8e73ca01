"""Trainings of probes on workers; frames and tokens lie in mapped files."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from touchgoal.benchmarks.papers.tacbench.config import Config
from touchgoal.benchmarks.papers.tacbench.data import RigFrames, Rows
from touchgoal.benchmarks.papers.tacbench.probes import (
    Inputs,
    PairTokens,
    ProbeTraining,
    Reader,
    find_encoder_of,
    inputs_of_tokens,
    read,
    train_reader,
)
from touchgoal.benchmarks.papers.tacbench.task import Task, thinned
from touchgoal.benchmarks.papers.tacbench.tasks import TASKS
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder

_LEAST_SAMPLES = 8
_Answered = list[Float[np.ndarray, "_ _"]]  # by seed: frames, outputs


@dataclass(frozen=True)
class Subject:
    """One encoder on one kind of recordings.

    Attributes:
        name: encoder, as the user named it.
        sensor: sensor of the rig.
        frames: file of `RigFrames` from the encoder's preprocessor.
        tokens: file of a frozen encoder's tokens; None for one that is trained.
    """

    name: str
    sensor: str
    frames: Path
    tokens: Path | None


@dataclass(frozen=True)
class Job:
    """One encoder, task and share of the labels, all seeds.

    Attributes:
        subject: encoder and its data.
        task: task by name.
        share: share of the training labels.
        config: schedule and seeds.
        log: file for the trainer's lines.
    """

    subject: Subject
    task: str
    share: float
    config: Config
    log: Path


@dataclass(frozen=True)
class Answers:
    """Outputs of a job's probes.

    Attributes:
        predicted: outputs on each test set, by seed.
        validation: outputs on the validation frames, by seed.
        samples: number of training labels.
        seconds: time of each training.
    """

    predicted: dict[str, _Answered]
    validation: _Answered
    samples: int
    seconds: float


def work(job: Job) -> Answers:
    """Train a job's probes, one a seed, and read the test frames; on one core."""
    torch.set_num_threads(1)
    config, began, scratch = job.config, time.monotonic(), job.subject.frames.parent
    frames = _mapped(job.subject.frames)
    task = TASKS[job.task](frames)
    encoder = _encoder(job.subject.name, job.subject.sensor, config.seed)
    inputs_of = _inputs_of(job.subject, encoder, frames)
    count = max(round(job.share * len(task.split.train)), _LEAST_SAMPLES)
    predicted: dict[str, _Answered] = {test: [] for test in task.split.tests}
    validation: _Answered = []
    for seed in range(config.seed, config.seed + config.seeds):
        reader = _reader(job.subject, encoder, task, seed)
        train = thinned(task.split.train, count, seed)
        training = _training(config, job.subject.tokens is None, seed)
        with job.log.open("a") as log:
            train_reader(reader, task, inputs_of, train, training, scratch, log)
        validation.append(read(reader, inputs_of, task.split.validation).numpy())
        for test, rows in task.split.tests.items():
            predicted[test].append(read(reader, inputs_of, rows).numpy())
    return Answers(predicted, validation, count, (time.monotonic() - began) / config.seeds)


@lru_cache(maxsize=2)
def _mapped(path: Path) -> RigFrames:
    return torch.load(path, mmap=True, weights_only=False)  # written by this run


@lru_cache(maxsize=1)
def _encoder(name: str, sensor: str, seed: int) -> BaseTouchEncoder:
    return find_encoder_of(name, sensor, seed)


def _inputs_of(
    subject: Subject, encoder: BaseTouchEncoder, frames: RigFrames
) -> Callable[[Rows], Inputs]:
    """Return the map from rows to a probe's input."""
    pairs = PairTokens(encoder)
    if subject.tokens is None:
        return partial(frames.stacked, offsets=pairs.offsets)
    return inputs_of_tokens(pairs, torch.load(subject.tokens, mmap=True), frames)


def _reader(subject: Subject, encoder: BaseTouchEncoder, task: Task, seed: int) -> Reader:
    """Return a probe with random weights, with an encoder if that is trained."""
    trained = subject.tokens is None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if trained:
            encoder = find_encoder_of(subject.name, subject.sensor, seed)
        return Reader(task, PairTokens(encoder), trained)


def _training(config: Config, trained: bool, seed: int) -> ProbeTraining:
    if trained:
        steps, size, lr = (
            config.end_to_end_steps,
            config.end_to_end_batch_size,
            config.end_to_end_lr,
        )
    else:
        steps, size, lr = config.steps, config.batch_size, config.lr
    return ProbeTraining(steps, size, lr, seed)

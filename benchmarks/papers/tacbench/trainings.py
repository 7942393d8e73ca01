"""Trainings of probes on workers; frames and tokens lie in mapped files."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from touchgoal.benchmarks.papers.tacbench import probes
from touchgoal.benchmarks.papers.tacbench.config import Config
from touchgoal.benchmarks.papers.tacbench.data import RigFrames, Rows
from touchgoal.benchmarks.papers.tacbench.force import FieldTask, ForceTask
from touchgoal.benchmarks.papers.tacbench.labels import grasp_task, textile_task
from touchgoal.benchmarks.papers.tacbench.pose import PoseTask
from touchgoal.benchmarks.papers.tacbench.slip import SlipTask
from touchgoal.benchmarks.papers.tacbench.task import Task, thinned
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
_BySeed = list[Float[np.ndarray, "_ _"]]  # outputs of frames


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


@dataclass(frozen=True)
class Answers:
    """Outputs of a job's probes on each test set and on the validation frames."""

    predicted: dict[str, _BySeed]
    validation: _BySeed
    samples: int  # training labels
    seconds: float  # of each training


def work(job: Job) -> Answers:
    """Train a job's probes, one a seed, and read the test frames; on one core."""
    torch.set_num_threads(1)
    config, subject, began = job.config, job.subject, time.monotonic()
    frames = _mapped(subject.frames)
    task = TASKS[job.task](frames)
    encoder = _encoder(subject.name, subject.sensor, config.seed)
    inputs_of = _inputs_of(subject, encoder, frames)
    count = max(round(job.share * len(task.split.train)), _LEAST_SAMPLES)
    predicted: dict[str, _BySeed] = {test: [] for test in task.split.tests}
    validation: _BySeed = []
    for seed in range(config.seed, config.seed + config.seeds):
        reader = _reader(subject, encoder, task, seed)
        train = thinned(task.split.train, count, seed)
        with job.log.open("a") as log:
            probes.train_reader(
                reader, task, inputs_of, train, config, seed, subject.frames.parent, log
            )
        validation.append(probes.read(reader, inputs_of, task.split.validation).numpy())
        for test, rows in task.split.tests.items():
            predicted[test].append(probes.read(reader, inputs_of, rows).numpy())
    return Answers(predicted, validation, count, (time.monotonic() - began) / config.seeds)


@lru_cache(maxsize=2)
def _mapped(path: Path) -> RigFrames:
    return torch.load(path, mmap=True, weights_only=False)  # written by this run


@lru_cache(maxsize=1)
def _encoder(name: str, sensor: str, seed: int) -> BaseTouchEncoder:
    return probes.find_encoder_of(name, sensor, seed)


def _inputs_of(
    subject: Subject, encoder: BaseTouchEncoder, frames: RigFrames
) -> Callable[[Rows], probes.Inputs]:
    """Return the map from rows to a probe's input."""
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

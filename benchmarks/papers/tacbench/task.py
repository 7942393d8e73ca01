"""The interface of a TacBench task, and which recordings it trains on, selects by and reports."""

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from benchmarks.papers.tacbench.data import RigFrames, Rows

VALIDATION, TEST = 3, 4
"""Use of the last two of every five recordings of an object; the first three are trained on."""
_MOST = 800  # frames of a force test, evenly spaced: neighbours are alike


@dataclass(frozen=True, eq=False)
class Split:
    """Rows of frames by use; no recording has two uses."""

    train: Rows
    validation: Rows  # selects snapshot and threshold
    tests: dict[str, Rows]


Outputs = Float[Tensor, "_ k"]
Targets = Float[Tensor, "_ _"]
Metrics = dict[str, Any]
"""Numbers by name; NAME_interval is the 95 % interval of NAME over recordings."""


@runtime_checkable
class Task(Protocol):
    """One task, on one set of frames."""

    split: Split

    def probe(self, features: int, grid: tuple[int, int]) -> nn.Module:
        """Return a probe with random weights, from tokens (b t f) to outputs.

        The last tokens are those of the patches, `grid` rows and columns of them.
        """
        ...

    def targets(self, rows: Rows) -> Targets:
        """Return the targets of some rows."""
        ...

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Return the training loss of raw outputs."""
        ...

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """Return the validation error by which snapshots are compared; lower is better."""
        ...

    def judge(self, predicted: list[Outputs], validation: list[Outputs], rows: Rows) -> Metrics:
        """Return the metrics of all training seeds together, from each seed's outputs.

        Thresholds are chosen by the outputs on validation frames.
        """
        ...

    def references(self, rows: Rows) -> dict[str, Metrics]:
        """Return the metrics of references that need no encoder, by name."""
        ...


def split_force(frames: RigFrames) -> Split:
    """Split as Sparsh (C.2): train on sphere and sharp probe, test on the flat one.

    A second test set has held-out strokes of the trained probes.
    """
    known = frames.pressed & (frames.indenter != "flat")
    split = _split(frames, known, "known probes")
    tests = {"flat probe, unseen": _rows(frames.pressed & (frames.indenter == "flat"))}
    tests |= split.tests
    return replace(split, tests={name: _evenly(rows) for name, rows in tests.items()})


def split_slip(frames: RigFrames) -> Split:
    """Split as Sparsh (C.4): the sphere alone."""
    return _split(frames, frames.pressed & (frames.indenter == "sphere"), "sphere")


def split_pose(frames: RigFrames) -> Split:
    """Split pairs of frames that are both in contact; every object has each use."""
    both = frames.pressed & frames.pressed[frames.before.numpy()]
    return _split(frames, both, "known objects")


def split_grasp(frames: RigFrames) -> Split:
    """Split pairs (before, gripped) and (gripped, lifted), finger by finger; every object has each use."""
    split = _split(frames, frames.later, "all")
    untouched_before = ~frames.later[frames.before.numpy()]
    test = split.tests["all"]
    gripped = torch.from_numpy(untouched_before)[test]
    return replace(split, tests={"gripped": test[gripped], "lifted": test[~gripped]})


def split_textile(frames: RigFrames) -> Split:
    """Split by piece: test pieces are of the same cloths."""
    return _split(frames, frames.later, "other pieces")


def thinned(rows: Rows, count: int, seed: int) -> Rows:
    """Draw `count` rows at random; with one seed a smaller sample is a prefix of a larger one."""
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
    return rows[order[:count]]


def _split(frames: RigFrames, chosen: Bool[np.ndarray, " n"], test: str) -> Split:
    use = _use(frames)
    tests = {test: _rows(chosen & (use == TEST))}
    return Split(_rows(chosen & (use < VALIDATION)), _rows(chosen & (use == VALIDATION)), tests)


def _use(frames: RigFrames) -> Int[np.ndarray, " n"]:
    """Assign 0 to 4 evenly over the recordings of each object."""
    use = np.empty(len(frames.stroke), np.int64)
    for k, name in enumerate(np.unique(frames.indenter)):
        own = frames.indenter == name
        use[own] = (k + np.unique(frames.stroke[own], return_inverse=True)[1]) % 5
    return use


def _evenly(rows: Rows) -> Rows:
    return rows[:: max(-(-len(rows) // _MOST), 1)]


def _rows(chosen: Bool[np.ndarray, " n"]) -> Rows:
    return torch.from_numpy(np.flatnonzero(chosen))

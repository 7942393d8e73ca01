"""Which recordings of the bench are learned from, chosen by, and reported on."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int

from touchgoal.benchmarks.tacbench.data import RigFrames, Rows

VALIDATION, TEST = 3, 4
"""Of every five recordings of a thing; the other three are trained on."""
_MOST = 800  # frames of a test of forces, evenly: neighbours tell little more


@dataclass(frozen=True, eq=False)
class Split:
    """Rows of frames: of each task other recordings for each use.

    Attributes:
        train: to learn from.
        validation: to choose a snapshot and a threshold by.
        tests: to report, by name.
    """

    train: Rows
    validation: Rows
    tests: dict[str, Rows]


def split_force(frames: RigFrames) -> Split:
    """As in Sparsh's C.2: learned from the sphere and the sharp probe, tested on the flat one.

    Beside it a test on other strokes of the probes learned from.
    """
    known = frames.pressed & (frames.indenter != "flat")
    tests = {
        "flat probe, unseen": _evenly(_rows(frames.pressed & (frames.indenter == "flat"))),
        "known probes": _evenly(_of_use(frames, known, TEST)),
    }
    return Split(_training(frames, known), _of_use(frames, known, VALIDATION), tests)


def split_slip(frames: RigFrames) -> Split:
    """As in Sparsh's C.4: the sphere alone."""
    return _split(frames, frames.pressed & (frames.indenter == "sphere"), "sphere")


def split_pose(frames: RigFrames) -> Split:
    """Pairs in which the object touches both times; every object in each use."""
    both = frames.pressed & frames.pressed[frames.before.numpy()]
    return _split(frames, both, "known objects")


def split_grasp(frames: RigFrames) -> Split:
    """Before and gripped, or gripped and lifted; every object in each use, fingers one by one."""
    split = _split(frames, frames.later, "all")
    untouched_before = ~frames.later[frames.before.numpy()]
    test = split.tests["all"]
    gripped = torch.from_numpy(untouched_before)[test]
    return Split(
        split.train, split.validation, {"gripped": test[gripped], "lifted": test[~gripped]}
    )


def split_textile(frames: RigFrames) -> Split:
    """Other pieces of the same cloths."""
    return _split(frames, frames.later, "other pieces")


def thinned(rows: Rows, count: int, seed: int) -> Rows:
    """So many rows, drawn at random; of one seed fewer rows are part of more."""
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
    return rows[order[:count]]


def _split(frames: RigFrames, chosen: Bool[np.ndarray, " n"], test: str) -> Split:
    tests = {test: _of_use(frames, chosen, TEST)}
    return Split(_training(frames, chosen), _of_use(frames, chosen, VALIDATION), tests)


def _use(frames: RigFrames) -> Int[np.ndarray, " n"]:
    """0 to 4, evenly over the recordings of each thing, and over things with few recordings; or as published."""
    if frames.use is not None:
        return frames.use
    use = np.empty(len(frames.stroke), np.int64)
    for k, name in enumerate(np.unique(frames.indenter)):
        own = frames.indenter == name
        use[own] = (k + np.unique(frames.stroke[own], return_inverse=True)[1]) % 5
    return use


def _of_use(frames: RigFrames, chosen: Bool[np.ndarray, " n"], use: int) -> Rows:
    return _rows(chosen & (_use(frames) == use))


def _evenly(rows: Rows) -> Rows:
    return rows[:: max(-(-len(rows) // _MOST), 1)]


def _training(frames: RigFrames, chosen: Bool[np.ndarray, " n"]) -> Rows:
    return _rows(chosen & (_use(frames) < VALIDATION))


def _rows(chosen: Bool[np.ndarray, " n"]) -> Rows:
    return torch.from_numpy(np.flatnonzero(chosen))

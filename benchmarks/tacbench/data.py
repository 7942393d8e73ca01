"""Strokes of the indenter rig as the samples of TacBench T1 to T3: pairs of frames, and their labels."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int
from torch import Tensor

from touchgoal.control.features import (
    TACTILE_LEFT,
    TRUTH_OBJECT_POSE,
    TRUTH_PAD_WRENCH,
    TRUTH_SLIP,
)
from touchgoal.control.progress import track
from touchgoal.encoders.backbones.frame_history import past_rows
from touchgoal.encoders.preprocess import Preprocessor
from touchgoal.episodes.store import EpisodeSet

STRIDE = 5
"""Frames between the two of a pair, as in Sparsh: 83 ms at the rig's 60 Hz."""
_VALIDATION, _TEST = 3, 4  # of every five strokes of a probe; the other three are trained on
_PRESSED_IS_POSITIVE = np.array([1, 1, -1], np.float32)

Rows = Int[Tensor, " _"]


@dataclass(frozen=True, eq=False)
class RigFrames:
    """n frames of strokes.

    Attributes:
        touch: preprocessed; half precision, for they fill the memory.
        before: row of the frame `STRIDE` earlier; of a stroke's first frames its first.
        force: of the probe on the pad, N: shear x and y, and the normal force, positive when pressed.
        slip: whether the probe slides.
        stroke: which.
        indenter: name of the probe or object.
        pose: of the object on the gel, x and y (mm) and turn (degrees); None if the set does not say.
    """

    touch: Float16[Tensor, "n 3 h w"]
    before: Rows
    force: Float[Tensor, "n 3"]
    slip: Bool[Tensor, " n"]
    stroke: Int[np.ndarray, " n"]
    indenter: np.ndarray
    pose: Float[Tensor, "n 3"] | None = None

    def seen(self, rows: Rows, offsets: tuple[int, ...]) -> Float[Tensor, "k t 3 h w"]:
        """Frames, and those so many frames before each; of a stroke's first frames its first."""
        newest = rows.numpy()
        first = np.searchsorted(self.stroke, self.stroke[newest])
        return self.touch[torch.from_numpy(past_rows(newest, offsets, first))].float()

    @property
    def pressed(self) -> Bool[np.ndarray, " n"]:
        """Where the probe touches."""
        return (self.force[:, 2] > 0).numpy()


@dataclass(frozen=True, eq=False)
class Split:
    """Rows of frames: of each task other strokes for each use.

    Attributes:
        train: to learn from.
        validation: to choose a snapshot and a threshold by.
        tests: to report, by name.
    """

    train: Rows
    validation: Rows
    tests: dict[str, Rows]


def read_strokes(strokes: EpisodeSet, count: int, preprocess: Preprocessor) -> RigFrames:
    """All frames of the first so many strokes; a stroke's background is its first frame."""
    keys = [TACTILE_LEFT, TRUTH_PAD_WRENCH, TRUTH_SLIP]
    keys += [TRUTH_OBJECT_POSE] if TRUTH_OBJECT_POSE in strokes.features else []
    touch, force, slip, pose = [], [], [], []
    for i in track(range(count), "strokes", "stroke"):
        frames = strokes.read(i, keys).frames
        pictures = frames[TACTILE_LEFT]
        touch.append(torch.from_numpy(preprocess(pictures, pictures[0])).half())
        force.append(torch.from_numpy(frames[TRUTH_PAD_WRENCH][:, :3] * _PRESSED_IS_POSITIVE))
        slip.append(torch.from_numpy(frames[TRUTH_SLIP][:, 0]))
        if TRUTH_OBJECT_POSE in frames:
            pose.append(torch.from_numpy(_planar(frames[TRUTH_OBJECT_POSE])))
    lengths = np.array([len(f) for f in force])
    starts = np.repeat(np.cumsum(lengths) - lengths, lengths)
    before = np.maximum(np.arange(lengths.sum()) - STRIDE, starts)
    names = [str(strokes.meta(i)["object"]) for i in range(count)]
    return RigFrames(
        torch.cat(touch),
        torch.from_numpy(before),
        torch.cat(force),
        torch.cat(slip),
        np.repeat(np.arange(len(lengths)), lengths),
        np.repeat(names, lengths),
        torch.cat(pose) if pose else None,
    )


def _planar(pose: Float32[np.ndarray, "t 7"]) -> Float32[np.ndarray, "t 3"]:
    """x and y, mm; turn about z, degrees."""
    turn = 2 * np.degrees(np.arctan2(pose[:, 6], pose[:, 3]))
    return np.column_stack([1e3 * pose[:, :2], turn]).astype(np.float32)


def split_force(frames: RigFrames) -> Split:
    """As in Sparsh's C.2: learned from the sphere and the sharp probe, tested on the flat one.

    Beside it a test on other strokes of the probes learned from.
    """
    known = frames.pressed & (frames.indenter != "flat")
    tests = {
        "flat probe, unseen": _rows(frames.pressed & (frames.indenter == "flat")),
        "known probes": _of_use(frames, known, _TEST),
    }
    return Split(_training(frames, known), _of_use(frames, known, _VALIDATION), tests)


def split_slip(frames: RigFrames) -> Split:
    """As in Sparsh's C.4: the sphere alone."""
    ball = frames.pressed & (frames.indenter == "sphere")
    tests = {"sphere": _of_use(frames, ball, _TEST)}
    return Split(_training(frames, ball), _of_use(frames, ball, _VALIDATION), tests)


def split_pose(frames: RigFrames) -> Split:
    """Pairs in which the object touches both times; every object in each use."""
    both = frames.pressed & frames.pressed[frames.before.numpy()]
    tests = {"known objects": _of_use(frames, both, _TEST)}
    return Split(_training(frames, both), _of_use(frames, both, _VALIDATION), tests)


def _use(frames: RigFrames) -> Int[np.ndarray, " n"]:
    """0 to 4, evenly over the strokes of each probe."""
    use = np.empty(len(frames.stroke), np.int64)
    for name in np.unique(frames.indenter):
        own = frames.indenter == name
        use[own] = np.unique(frames.stroke[own], return_inverse=True)[1] % 5
    return use


def _of_use(frames: RigFrames, chosen: Bool[np.ndarray, " n"], use: int) -> Rows:
    return _rows(chosen & (_use(frames) == use))


def _training(frames: RigFrames, chosen: Bool[np.ndarray, " n"]) -> Rows:
    return _rows(chosen & (_use(frames) < _VALIDATION))


def _rows(chosen: Bool[np.ndarray, " n"]) -> Rows:
    return torch.from_numpy(np.flatnonzero(chosen))

"""Samples of TacBench from the bench's recordings: frames of one sensor, and their labels."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int, UInt8
from torch import Tensor

from benchmarks.papers.tacbench_rig.cloths import CLOTHS
from benchmarks.papers.tacbench_rig.config import RigConfig
from benchmarks.papers.tacbench_rig.strokes import simulate
from touchgoal.control import features as ft
from touchgoal.encoders.backbones.frame_history import past_rows
from touchgoal.encoders.preprocess import Preprocessor
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track

STRIDE = 5  # frames between the two of a pair, as in Sparsh: 83 ms at the rig's 60 Hz
_PRESSED_IS_POSITIVE = np.array([1, 1, -1], np.float32)

Rows = Int[Tensor, " _"]


@dataclass(frozen=True, eq=False)
class RigFrames:
    """Labelled frames of n rows; a recording's frames are consecutive.

    `before` is the row of the pair's other frame: `STRIDE` earlier, or the recording's first; for a
    grasp the moment before.
    """

    touch: Float16[Tensor, "n 3 h w"]  # preprocessed; half precision saves memory
    before: Rows
    force: Float[Tensor, "n 3"]  # on the pad, N: shear x and y; normal, positive when pressed
    slip: Bool[Tensor, " n"]  # whether the probe slides
    stroke: Int[np.ndarray, " n"]  # recording of each frame; both fingers of a grasp share one
    indenter: np.ndarray  # name of the probe, object or cloth
    pose: Float[Tensor, "n 3"] | None = None  # of the object: x and y (mm), turn (degrees)
    label: Int[Tensor, " n"] | None = None  # grasp success, or number of the cloth
    field: Float[Tensor, "n 3 24 24"] | None = None  # shear along x and y, and pressure, kPa
    moments: int = 0  # frames of each finger of a grasp; 0 for recordings in time

    def stacked(self, rows: Rows, offsets: tuple[int, ...]) -> Float[Tensor, "k t 3 h w"]:
        """Return frames and those before each; a stroke's first frames repeat its first.

        For grasps, whose moments are seconds apart, an offset of `STRIDE` is the moment before.
        """
        newest = rows.numpy()
        first = np.searchsorted(self.stroke, self.stroke[newest])
        if self.moments:
            first = newest - newest % self.moments
            offsets = tuple(round(offset / STRIDE) for offset in offsets)
        return self.touch[torch.from_numpy(past_rows(newest, offsets, first))].float()

    @property
    def pressed(self) -> Bool[np.ndarray, " n"]:
        """Frames in which the probe touches."""
        return (self.force[:, 2] > 0).numpy()

    @property
    def later(self) -> Bool[np.ndarray, " n"]:
        """Frames other than each recording's first, untouched one."""
        return (self.before != torch.arange(len(self.before))).numpy()


def assemble(
    touch: list[Float16[Tensor, "_ 3 h w"]],
    names: list[str],
    lengths: list[int],
    force: Float[Tensor, "n 3"] | None = None,
    slip: Bool[Tensor, " n"] | None = None,
    moments: int = 0,
    **labels: Any,
) -> RigFrames:
    """Return frames of recordings one after the other; forces and slip are 0 where unknown."""
    n = sum(lengths)
    before = rows_before([moments] * (n // moments), 1) if moments else rows_before(lengths, STRIDE)
    return RigFrames(
        torch.cat(touch),
        before,
        torch.zeros(n, 3) if force is None else force,
        torch.zeros(n, dtype=torch.bool) if slip is None else slip,
        np.repeat(np.arange(len(names)), lengths),
        np.repeat(names, lengths),
        moments=moments,
        **labels,
    )


def read_strokes(strokes: EpisodeSet, count: int, preprocess: Preprocessor) -> RigFrames:
    """Read the first strokes or slides; a stroke's background is its first frame."""
    keys = [ft.TACTILE_LEFT, ft.TRUTH_PAD_WRENCH, ft.TRUTH_SLIP]
    keys += [ft.TRUTH_OBJECT_POSE] if ft.TRUTH_OBJECT_POSE in strokes.features else []
    touch, force, slip, pose = [], [], [], []
    for i in track(range(count), "strokes", "stroke"):
        frames = strokes.read(i, keys).frames
        touch.append(preprocessed(frames[ft.TACTILE_LEFT], preprocess))
        force.append(torch.from_numpy(frames[ft.TRUTH_PAD_WRENCH][:, :3] * _PRESSED_IS_POSITIVE))
        slip.append(torch.from_numpy(frames[ft.TRUTH_SLIP][:, 0]))
        if ft.TRUTH_OBJECT_POSE in frames:
            pose.append(torch.from_numpy(_planar(frames[ft.TRUTH_OBJECT_POSE])))
    names, lengths = _names(strokes, count), [len(f) for f in force]
    poses = torch.cat(pose) if pose else None
    return assemble(touch, names, lengths, torch.cat(force), torch.cat(slip), pose=poses)


def read_grasps(grasps: EpisodeSet, count: int, preprocess: Preprocessor) -> RigFrames:
    """Read the first grasps, finger by finger: before, gripped, lifted."""
    touch, force, label = [], [], []
    for i in track(range(count), "grasps", "attempt"):
        keys = [ft.TACTILE_LEFT, ft.TACTILE_RIGHT, ft.TRUTH_PAD_WRENCH, ft.TRUTH_SUCCESS]
        frames = grasps.read(i, keys).frames
        for side, key in enumerate((ft.TACTILE_LEFT, ft.TACTILE_RIGHT)):
            touch.append(preprocessed(frames[key], preprocess))
            wrench = frames[ft.TRUTH_PAD_WRENCH][:, 6 * side : 6 * side + 3]
            force.append(torch.from_numpy(wrench * _PRESSED_IS_POSITIVE))
            label += [int(frames[ft.TRUTH_SUCCESS][-1, 0])] * len(wrench)
    moments, names, labels = len(touch[0]), _names(grasps, count), torch.tensor(label)
    lengths = [2 * moments] * count
    return assemble(touch, names, lengths, torch.cat(force), moments=moments, label=labels)


def read_cloths(clips: EpisodeSet, count: int, preprocess: Preprocessor) -> RigFrames:
    """Read the first presses of cloth."""
    numbers = {cloth.name: i for i, cloth in enumerate(CLOTHS)}
    touch = [
        preprocessed(clips.read(i, [ft.TACTILE_LEFT]).frames[ft.TACTILE_LEFT], preprocess)
        for i in track(range(count), "cloths", "press")
    ]
    names, lengths = _names(clips, count), [len(frames) for frames in touch]
    label = torch.tensor(np.repeat([numbers[name] for name in names], lengths))
    return assemble(touch, names, lengths, label=label)


def with_fields(frames: RigFrames, rig: RigConfig, workers: int) -> RigFrames:
    """Add the true field, simulated again from the same strokes."""
    count = int(frames.stroke[-1]) + 1
    with parallel_map(partial(_field, rig), range(count), workers) as made:
        fields = list(track(made, "force fields", "stroke", total=count))
    return replace(frames, field=torch.from_numpy(np.concatenate(fields)))


def _field(rig: RigConfig, index: int) -> Float32[np.ndarray, "t 3 24 24"]:
    return simulate(rig, index).field


def preprocessed(
    images: UInt8[np.ndarray, "t h w 3"], preprocess: Preprocessor
) -> Float16[Tensor, "t 3 H W"]:
    """Preprocess images; their background is the first one."""
    return torch.from_numpy(preprocess(images, images[0])).half()


def rows_before(lengths: list[int], stride: int) -> Rows:
    """Return the rows `stride` frames earlier, or the first of each recording."""
    starts = np.repeat(np.cumsum(lengths) - lengths, lengths)
    return torch.from_numpy(np.maximum(np.arange(sum(lengths)) - stride, starts))


def _names(episodes: EpisodeSet, count: int) -> list[str]:
    return [str(episodes.meta(i)["object"]) for i in range(count)]


def _planar(pose: Float32[np.ndarray, "t 7"]) -> Float32[np.ndarray, "t 3"]:
    """Return x and y in mm and the turn about z in degrees."""
    turn = 2 * np.degrees(np.arctan2(pose[:, 6], pose[:, 3]))
    return np.column_stack([1e3 * pose[:, :2], turn]).astype(np.float32)

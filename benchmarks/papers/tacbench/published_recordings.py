"""Published recordings as samples of TacBench: force and slip, pose, grasps.

A recording is what the publisher made in one go: a stroke, a bag, a grasp. Only the middle of a long
recording is read.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from benchmarks.papers.tacbench.config import RECORDED_AS, Recording
from benchmarks.papers.tacbench.data import STRIDE, RigFrames, assemble, preprocessed
from benchmarks.papers.tacbench.task import TEST, VALIDATION
from touchgoal.encoders.preprocess import Preprocessor
from touchgoal.episodes.importers.feeling_of_success import MOMENTS, is_grasp_set, read_grasps
from touchgoal.episodes.importers.tacbench_forces import is_force_set, read_strokes
from touchgoal.episodes.importers.tacbench_poses import is_pose_set, read_bags
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_LONGEST = 180  # images of a recording that are read
_OF_FIVE = 5
_PER_METRE, _PER_RADIAN = 1e3, 180 / np.pi

Item = TypeVar("Item")


@dataclass(frozen=True)
class Published:
    """A published folder."""

    what: Recording
    sensor: str
    read: Callable[[int, Preprocessor], RigFrames]  # reads a number of recordings


def find_published(folder: Path, sensor: str) -> Published | None:
    """Return a folder's published files; None if it has none.

    UserError: the first file is damaged.

    Args:
        folder: TacBench's force or pose estimation, or Feeling of Success.
        sensor: decides between gels with and without dots, where the files do not.
    """
    if is_force_set(folder):
        named = _variant(sensor, _first(read_strokes(folder), folder).clip.sensor)
        return Published("strokes", named, partial(read_published_strokes, folder, named))
    if is_pose_set(folder):
        named = _first(read_bags(folder), folder).clip.sensor
        return Published("slides", named, partial(read_published_bags, folder))
    if is_grasp_set(folder):
        named = _variant(sensor, _first(read_grasps(folder), folder).fingers[0].sensor)
        return Published("grasps", named, partial(read_published_grasps, folder, named))
    return None


def read_published_strokes(
    folder: Path, sensor: str, count: int, preprocess: Preprocessor
) -> RigFrames:
    """Read about that many strokes, as many of each probe, split as in simulation."""
    chosen = _evenly(list(read_strokes(folder, sensor)), lambda stroke: stroke.probe, count)
    touch, force, slip = [], [], []
    for stroke in track(chosen, "strokes", "stroke"):
        part = _middle(len(stroke.rows))
        frames = stroke.clip.frames(stroke.rows[part])
        touch.append(preprocessed(frames, preprocess, stroke.background()))
        force.append(stroke.force[part])
        slip.append(stroke.slip[part])
    names, lengths = [stroke.probe for stroke in chosen], [len(labels) for labels in slip]
    forces, slips = (torch.from_numpy(np.concatenate(parts)) for parts in (force, slip))
    return assemble(touch, names, lengths, forces.float(), slips)


def read_published_bags(folder: Path, count: int, preprocess: Preprocessor) -> RigFrames:
    """Read about that many bags of the ring finger; test bags are the published ones.

    Forces are unknown; since the object always touches, 1 N into the gel stands for contact. The first
    `STRIDE` frames of a bag have no motion and count as untouched.
    """
    chosen = _evenly(list(read_bags(folder)), lambda bag: (bag.object, bag.held_out), count)
    touch, force, pose = [], [], []
    for bag in track(chosen, "bags", "bag"):
        part = _middle(len(bag.clip))
        frames = bag.clip.frames(np.arange(len(bag.clip))[part])
        touch.append(preprocessed(frames, preprocess, bag.background()))
        pose.append(_poses(bag.change)[part])
        force.append(np.outer(np.arange(len(frames)) >= STRIDE, (0, 0, 1)))
    names, lengths = [bag.object for bag in chosen], [len(poses) for poses in pose]
    forces, poses = (torch.from_numpy(np.concatenate(parts)) for parts in (force, pose))
    use = np.repeat(_uses([bag.held_out for bag in chosen]), lengths)
    return assemble(touch, names, lengths, forces.float(), pose=poses, use=use)


def read_published_grasps(
    folder: Path, sensor: str, count: int, preprocess: Preprocessor
) -> RigFrames:
    """Read about that many grasps, finger by finger; test grasps are the published ones."""
    trials = list(read_grasps(folder, sensor))
    chosen = _evenly(trials, lambda trial: (trial.held_out, trial.held), count)
    touch: list[Tensor] = []
    for trial in track(chosen, "grasps", "attempt"):
        for finger in trial.fingers:
            frames = finger.frames(range(len(MOMENTS)))
            touch.append(preprocessed(frames, preprocess))
    moments, names = len(MOMENTS), [trial.object for trial in chosen]
    each = 2 * moments
    label = torch.tensor([int(trial.held) for trial in chosen]).repeat_interleave(each)
    use = np.repeat(_uses([trial.held_out for trial in chosen]), each)
    lengths = [each] * len(chosen)
    return assemble(touch, names, lengths, moments=moments, label=label, use=use)


def _first(items: Iterable[Item], folder: Path) -> Item:
    for item in items:
        return item
    raise UserError(f"{folder} holds no recording: get it again, as published")


def _variant(asked: str, found: str) -> str:
    """Return the requested sensor if it differs from the found one in dots alone."""
    return asked if asked in (found, f"{found}_markers") else found


def _evenly(items: list[Item], group: Callable[[Item], Hashable], count: int) -> list[Item]:
    """Return about that many, in order, and the same share of each group, at least one."""
    groups: dict[Hashable, list[int]] = {}
    for i, item in enumerate(items):
        groups.setdefault(group(item), []).append(i)
    chosen: list[int] = []
    for own in groups.values():
        n = min(max(round(count * len(own) / len(items)), 1), len(own))
        chosen += [own[i] for i in np.linspace(0, len(own) - 1, n).astype(int)]
    return [items[i] for i in sorted(chosen)]


def _middle(length: int) -> slice:
    """Return the part of a recording that is read."""
    start = max(length - _LONGEST, 0) // 2
    return slice(start, start + min(length, _LONGEST))


def _poses(change: Float64[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Return poses (mm, degrees) whose change over a stride is as published."""
    pose = np.zeros_like(change)
    for i in range(STRIDE, len(change)):
        pose[i] = pose[i - STRIDE] + change[i]
    return (pose * (_PER_METRE, _PER_METRE, _PER_RADIAN)).astype(np.float32)


def _uses(held_out: Sequence[bool]) -> Int64[np.ndarray, " n"]:
    """Assign the held-out recordings to the test and every fifth other to validation."""
    uses = np.zeros(len(held_out), np.int64)
    uses[np.flatnonzero(~np.array(held_out))[_OF_FIVE - 1 :: _OF_FIVE]] = VALIDATION
    uses[np.array(held_out)] = TEST
    return uses


def check_tasks(published: Published, folder: Path, tasks: Sequence[str]) -> None:
    """Raise UserError if these files do not serve a task."""
    fit = [name for name, what in RECORDED_AS.items() if what == published.what and name != "field"]
    if wrong := [name for name in tasks if name not in fit]:
        raise UserError(
            f"{folder} is not for {' and '.join(wrong)}: choose --tasks {' '.join(fit)}, or other files"
        )

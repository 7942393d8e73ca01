"""Recording of touches of one simulated sensor as sets of episodes, on all cores.

The sensor is the left fingertip; the right one has no images, and its truth is zero.
"""

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from touchgoal.control import features as ft
from touchgoal.episodes.format.encoding import EncodedEpisode, encode
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import Workers, parallel_map
from touchgoal.runtime.parallel.shard import WHOLE, Shard
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.object_slides import FPS, LOAD, Slide, simulate_object_slide

_RIG = "rig"  # meta: options of the rig
Recorded = tuple[dict[str, np.ndarray], str, dict[str, Any]]
"""Frames, task and meta of one recording."""


def record_slides(
    root: Path, sensor: str, seed: int, count: int, workers: Workers, shard: Shard = WHOLE
) -> EpisodeSet:
    """Record slides of pick-and-place's objects, each on another sensor instance; see `record_rig`."""
    low, high = LOAD
    rig = f"{sensor}, objects, {low:g} to {high:g} N, seed {seed}"
    return record_rig(root, partial(_object_slide, sensor, seed), rig, count, workers, shard)


def record_rig(
    root: Path,
    simulate: Callable[[int], Recorded],
    rig: str,
    count: int,
    workers: Workers,
    shard: Shard = WHOLE,
) -> EpisodeSet:
    """Record the first `count` episodes of a rig; those that the folder holds are not simulated again.

    `simulate` makes a recording from its number, in another process; `rig` describes the rig and its
    seed. UserError: the folder holds recordings of another rig, or cannot be written to.
    """
    with closing(EpisodeWriter(root, fps=FPS)) as writer:
        meta = EpisodeSet(root).meta(0) if len(writer) else {}
        if meta and (other := meta.get(_RIG)) != rig:
            raise UserError(
                f"{root} holds recordings of another rig ({other}), not {rig}: give another folder"
            )
        if meta:
            shard.require(int(str(meta["stroke"])), root)
        if missing := [i for i in range(count) if shard.holds(i)][len(writer) :]:
            with parallel_map(partial(_encoded, simulate, rig), missing, workers) as made:
                for episode in track(made, root.name, "recording", total=len(missing)):
                    writer.append(episode)
    return EpisodeSet(root)


def _encoded(simulate: Callable[[int], Recorded], rig: str, index: int) -> EncodedEpisode:
    frames, task, meta = simulate(index)
    return encode(Episode(frames, task, {_RIG: rig, **meta, "stroke": index}), FPS)


def _object_slide(sensor: str, seed: int, index: int) -> Recorded:
    frames, task, meta = slide_episode(simulate_object_slide(sensor, seed, index))
    return frames, task, {"sensor": sensor, **meta}


def slide_episode(slide: Slide) -> Recorded:
    """Return a slide's columns, task and meta."""
    half, zero = slide.pose[:, 2] / 2, np.zeros(len(slide.pose), np.float32)
    turned = np.column_stack([np.cos(half), zero, zero, np.sin(half)])
    frames = left_fingertip(slide.frames, slide.wrench, slide.slip)
    frames[ft.TRUTH_OBJECT_POSE] = np.column_stack([slide.pose[:, :2], zero, turned]).astype("f4")
    task = f"slide and turn a {slide.held} on the sensor"
    return frames, task, {"object": slide.held, "load": slide.load}


def left_fingertip(
    images: UInt8[np.ndarray, "t h w 3"],
    wrench: Float32[np.ndarray, "t 6"],
    slip: Bool[np.ndarray, " t"],
) -> dict[str, np.ndarray]:
    """Return the columns of the left fingertip, and of a right one without contact."""
    n = len(images)
    nothing = np.zeros(n, bool)
    return {
        ft.TACTILE_LEFT: images,
        ft.TRUTH_PAD_WRENCH: np.hstack([wrench, np.zeros((n, 6), np.float32)]),
        ft.TRUTH_CONTACT: np.column_stack([wrench[:, 2] < 0, nothing]),
        ft.TRUTH_SLIP: np.column_stack([slip, nothing]),
    }

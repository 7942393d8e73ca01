"""Recording of the simulated touch bench as sets of episodes, on all cores.

A single sensor is the left fingertip; the right one then has no images, and its truth is zero.
"""

from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from touchgoal.control.features import (
    TACTILE_LEFT,
    TACTILE_RIGHT,
    TRUTH_CONTACT,
    TRUTH_OBJECT_POSE,
    TRUTH_PAD_WRENCH,
    TRUTH_SLIP,
    TRUTH_SUCCESS,
)
from touchgoal.episodes.format.encoding import EncodedEpisode, encode
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import Workers, parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import RigConfig
from touchgoal.sim_envs.grasp_rig import attempt_grasp
from touchgoal.sim_envs.indenter_rig import FPS, simulate
from touchgoal.sim_envs.object_slides import HELD, Slide, simulate_catalogue_slide, simulate_slide
from touchgoal.sim_envs.tactile.rig.cloths import CLOTHS, press_cloth

Recording = Literal["strokes", "slides", "catalogue slides", "grasps", "cloths"]
"""Content of a set: indenter strokes; slides of held shapes, or of pick-and-place's objects, each on another
sensor instance; grasp attempts of three frames; presses of cloth."""
_RIG = "rig"  # meta: options of the rig
Recorded = tuple[dict[str, np.ndarray], str, dict[str, Any]]  # frames, task, meta


def record_bench(
    what: Recording, root: Path, config: RigConfig, count: int, workers: Workers
) -> EpisodeSet:
    """Record the first `count` episodes of a rig; those that the folder holds are not simulated again.

    UserError: the folder holds recordings of another rig, or cannot be written to.
    """
    shapes = {"strokes": config.indenters, "slides": HELD, "catalogue slides": ("objects",)}
    low, high = config.load
    loads = f"{low:g} to {high:g} N{', no relief' * (not config.shear_relief)}"
    rig = f"{config.sensor}, {'+'.join(shapes.get(what, (what,)))}, {loads}, seed {config.seed}"
    with closing(EpisodeWriter(root, fps=FPS)) as writer:
        if len(writer) and (other := EpisodeSet(root).meta(0).get(_RIG)) != rig:
            raise UserError(
                f"{root} holds recordings of another rig ({other}), not {rig}: give another folder"
            )
        if len(writer) < count:
            missing = range(len(writer), count)
            with parallel_map(partial(_encoded, what, config, rig), missing, workers) as made:
                for episode in track(made, root.name, "recording", total=len(missing)):
                    writer.append(episode)
    return EpisodeSet(root)


def _encoded(what: Recording, config: RigConfig, rig: str, index: int) -> EncodedEpisode:
    simulators = {
        "strokes": _stroke,
        "slides": partial(_slide, simulate_slide),
        "catalogue slides": partial(_slide, simulate_catalogue_slide),
        "grasps": _grasp,
        "cloths": _cloth,
    }
    frames, task, meta = simulators[what](config, index)
    meta = {_RIG: rig, "sensor": config.sensor, **meta, "stroke": index}
    return encode(Episode(frames, task, meta), FPS)


def _stroke(config: RigConfig, index: int) -> Recorded:
    stroke = simulate(config, index)
    load, friction = float(stroke.load), float(stroke.friction)
    return (
        _frames(stroke.frames, stroke.wrench, stroke.slip),
        f"press a {stroke.indenter} probe into the sensor and slide it",
        {"object": stroke.indenter, "load": load, "friction": friction},
    )


def _slide(simulate: Callable[[RigConfig, int], Slide], config: RigConfig, index: int) -> Recorded:
    slide = simulate(config, index)
    half, zero = slide.pose[:, 2] / 2, np.zeros(len(slide.pose), np.float32)
    turned = np.column_stack([np.cos(half), zero, zero, np.sin(half)])
    frames = _frames(slide.frames, slide.wrench, slide.slip)
    frames[TRUTH_OBJECT_POSE] = np.column_stack([slide.pose[:, :2], zero, turned]).astype("f4")
    task = f"slide and turn a {slide.held} on the sensor"
    return frames, task, {"object": slide.held, "load": slide.load}


def _grasp(config: RigConfig, index: int) -> Recorded:
    attempt = attempt_grasp(config, index)
    name, held = attempt.body.kind.name, attempt.held
    frames = {
        TACTILE_LEFT: attempt.left,
        TACTILE_RIGHT: attempt.right,
        TRUTH_PAD_WRENCH: attempt.wrench,
        TRUTH_CONTACT: attempt.wrench[:, [2, 8]] < 0,
        TRUTH_SUCCESS: np.array([[False], [False], [held]]),
    }
    meta = {"object": name, "grip": attempt.grip, "mass": attempt.body.mass, "success": held}
    return frames, f"grasp the {name.replace('_', ' ')} and lift it", meta


def _cloth(config: RigConfig, index: int) -> Recorded:
    clip = press_cloth(config, index)
    name = CLOTHS[clip.cloth].name
    return {TACTILE_LEFT: clip.frames}, f"press on {name}", {"object": name}


def _frames(
    pictures: UInt8[np.ndarray, "t h w 3"],
    wrench: Float32[np.ndarray, "t 6"],
    slip: Bool[np.ndarray, " t"],
) -> dict[str, np.ndarray]:
    """Return the columns of the left fingertip, and of a right one without contact."""
    n = len(pictures)
    nothing = np.zeros(n, bool)
    return {
        TACTILE_LEFT: pictures,
        TRUTH_PAD_WRENCH: np.hstack([wrench, np.zeros((n, 6), np.float32)]),
        TRUTH_CONTACT: np.column_stack([wrench[:, 2] < 0, nothing]),
        TRUTH_SLIP: np.column_stack([slip, nothing]),
    }

"""Recording of the simulated touch bench as sets of episodes, on all cores.

Indenter strokes, slides of objects, grasp attempts and presses of cloth. A single sensor is the left
fingertip; the right one then has no images, and its ground truth is zero.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

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
from touchgoal.runtime.progress import track
from touchgoal.runtime.worker_pool import one_core_workers
from touchgoal.sim_envs.cloths import CLOTHS, press_cloth
from touchgoal.sim_envs.config import RigConfig
from touchgoal.sim_envs.grasp_rig import attempt_grasp
from touchgoal.sim_envs.indenter_rig import FPS, simulate
from touchgoal.sim_envs.object_slides import (
    HELD,
    Slide,
    simulate_catalogue_slide,
    simulate_slide,
)

_RIG = "rig"  # meta: options of the rig


def record_strokes(root: Path, config: RigConfig, count: int, workers: int) -> EpisodeSet:
    """Record the first `count` strokes of a rig; those that the folder holds are not simulated again.

    Raises:
        UserError: The folder holds recordings of another rig, or cannot be written to.
    """
    rig = _description(config, config.indenters)
    return _record_missing(root, rig, partial(_stroke, config, rig), count, workers)


def record_slides(root: Path, config: RigConfig, count: int, workers: int) -> EpisodeSet:
    """Record slides of held shapes, as `record_strokes`."""
    rig = _description(config, HELD)
    return _record_missing(root, rig, partial(_slide, config, rig), count, workers)


def record_catalogue_slides(root: Path, config: RigConfig, count: int, workers: int) -> EpisodeSet:
    """Record slides of pick-and-place's objects, each on another sensor instance, as `record_strokes`."""
    rig = _description(config, ("objects",))
    record = partial(_slide, config, rig, simulate=simulate_catalogue_slide)
    return _record_missing(root, rig, record, count, workers)


def record_grasps(root: Path, config: RigConfig, count: int, workers: int) -> EpisodeSet:
    """Record grasp attempts of three frames each, as `record_strokes`."""
    rig = _description(config, ("grasps",))
    return _record_missing(root, rig, partial(_grasp, config, rig), count, workers)


def record_cloths(root: Path, config: RigConfig, count: int, workers: int) -> EpisodeSet:
    """Record presses of cloth, as `record_strokes`."""
    rig = _description(config, ("cloths",))
    return _record_missing(root, rig, partial(_cloth, config, rig), count, workers)


def _description(config: RigConfig, shapes: tuple[str, ...]) -> str:
    """Return all options that the recordings depend on, so that two rigs are not mixed."""
    low, high = config.load
    loads = f"{low:g} to {high:g} N{', no relief' * (not config.shear_relief)}"
    return f"{config.sensor}, {'+'.join(shapes)}, {loads}, seed {config.seed}"


def _record_missing(
    root: Path, rig: str, record: Callable[[int], EncodedEpisode], count: int, workers: int
) -> EpisodeSet:
    writer = EpisodeWriter(root, fps=FPS)
    try:
        if len(writer) and (other := EpisodeSet(root).meta(0).get(_RIG)) != rig:
            raise UserError(
                f"{root} holds recordings of another rig ({other}), not {rig}: give another folder"
            )
        if len(writer) < count:
            with one_core_workers(workers) as pool:
                missing = range(len(writer), count)
                made = pool.map(record, missing)
                for episode in track(made, root.name, "recording", total=len(missing)):
                    writer.append(episode)
    finally:
        writer.close()
    return EpisodeSet(root)


def _stroke(config: RigConfig, rig: str, index: int) -> EncodedEpisode:
    stroke = simulate(config, index)
    frames = _frames(stroke.frames, stroke.wrench, stroke.slip)
    meta = {
        _RIG: rig,
        "sensor": config.sensor,
        "object": stroke.indenter,
        "load": float(stroke.load),
        "friction": float(stroke.friction),
        "stroke": index,
    }
    task = f"press a {stroke.indenter} probe into the sensor and slide it"
    return encode(Episode(frames, task, meta), FPS)


def _slide(
    config: RigConfig,
    rig: str,
    index: int,
    simulate: Callable[[RigConfig, int], Slide] = simulate_slide,
) -> EncodedEpisode:
    slide = simulate(config, index)
    half, zero = slide.pose[:, 2] / 2, np.zeros(len(slide.pose), np.float32)
    turned = np.column_stack([np.cos(half), zero, zero, np.sin(half)])
    frames = _frames(slide.frames, slide.wrench, slide.slip)
    frames[TRUTH_OBJECT_POSE] = np.column_stack([slide.pose[:, :2], zero, turned]).astype("f4")
    meta = {
        _RIG: rig,
        "sensor": config.sensor,
        "object": slide.held,
        "load": slide.load,
        "stroke": index,
    }
    return encode(Episode(frames, f"slide and turn a {slide.held} on the sensor", meta), FPS)


def _grasp(config: RigConfig, rig: str, index: int) -> EncodedEpisode:
    attempt = attempt_grasp(config, index)
    pressed = attempt.wrench[:, [2, 8]] < 0
    frames = {
        TACTILE_LEFT: attempt.left,
        TACTILE_RIGHT: attempt.right,
        TRUTH_PAD_WRENCH: attempt.wrench,
        TRUTH_CONTACT: pressed,
        TRUTH_SUCCESS: np.array([[False], [False], [attempt.held]]),
    }
    name = attempt.body.kind.name
    meta = {
        _RIG: rig,
        "sensor": config.sensor,
        "object": name,
        "grip": attempt.grip,
        "mass": attempt.body.mass,
        "success": attempt.held,
        "stroke": index,
    }
    return encode(Episode(frames, f"grasp the {name.replace('_', ' ')} and lift it", meta), FPS)


def _cloth(config: RigConfig, rig: str, index: int) -> EncodedEpisode:
    clip = press_cloth(config, index)
    name = CLOTHS[clip.cloth].name
    meta = {_RIG: rig, "sensor": config.sensor, "object": name, "stroke": index}
    return encode(Episode({TACTILE_LEFT: clip.frames}, f"press on {name}", meta), FPS)


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

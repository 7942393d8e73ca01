"""Strokes of the indenter rig as a set of episodes: one stroke an episode, made on all cores.

The rig's one sensor is the left fingertip; of the right one the truth is zeros, and there are no pictures.
"""

from functools import partial
from pathlib import Path

import numpy as np

from touchgoal.control.errors import UserError
from touchgoal.control.features import (
    TACTILE_LEFT,
    TRUTH_CONTACT,
    TRUTH_PAD_WRENCH,
    TRUTH_SLIP,
)
from touchgoal.control.progress import track
from touchgoal.episodes.encoding import EncodedEpisode, encode
from touchgoal.episodes.recording import one_core_workers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.sim_envs.config import RigConfig
from touchgoal.sim_envs.indenter_rig import FPS, simulate


def record_strokes(root: Path, config: RigConfig, count: int, workers: int) -> EpisodeSet:
    """The first so many strokes of a rig, of which those that a folder lacks are simulated.

    Interrupted, it keeps the strokes that were finished, and goes on with the next one.

    Raises:
        UserError: the folder holds strokes of another rig, or cannot be written to.
    """
    writer = EpisodeWriter(root, fps=FPS)
    try:
        if len(writer):
            _check_rig(EpisodeSet(root), config)
        if len(writer) < count:
            with one_core_workers(workers) as pool:
                missing = range(len(writer), count)
                strokes = pool.map(partial(_record, config), missing)
                for stroke in track(strokes, "indenter rig", "stroke", total=len(missing)):
                    writer.append(stroke)
    finally:
        writer.close()
    return EpisodeSet(root)


def _check_rig(known: EpisodeSet, config: RigConfig) -> None:
    said = known.meta(0).get("rig")
    if said != _description(config):
        raise UserError(
            f"{known.root} holds strokes of another rig ({said}), not {_description(config)}: give "
            "another folder"
        )


def _description(config: RigConfig) -> str:
    low, high = config.load
    probes = "+".join(config.indenters)
    return f"{config.sensor}, {probes}, {low:g} to {high:g} N, seed {config.seed}"


def _record(config: RigConfig, index: int) -> EncodedEpisode:
    stroke = simulate(config, index)
    n = len(stroke.frames)
    pressed = stroke.wrench[:, 2] < 0
    frames = {
        TACTILE_LEFT: stroke.frames,
        TRUTH_PAD_WRENCH: np.hstack([stroke.wrench, np.zeros((n, 6), np.float32)]),
        TRUTH_CONTACT: np.column_stack([pressed, np.zeros(n, bool)]),
        TRUTH_SLIP: np.column_stack([stroke.slip, np.zeros(n, bool)]),
    }
    meta = {
        "rig": _description(config),
        "sensor": config.sensor,
        "object": stroke.indenter,
        "load": float(stroke.load),
        "friction": float(stroke.friction),
        "stroke": index,
    }
    task = f"press a {stroke.indenter} probe into the sensor and slide it"
    return encode(Episode(frames, task, meta), FPS)

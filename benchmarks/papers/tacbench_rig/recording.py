"""Recording of TacBench's simulated bench as sets of episodes."""

from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.papers.tacbench_rig.cloths import CLOTHS, press_cloth
from benchmarks.papers.tacbench_rig.config import RigConfig
from benchmarks.papers.tacbench_rig.grasps import attempt_grasp
from benchmarks.papers.tacbench_rig.held_slides import HELD, simulate_slide
from benchmarks.papers.tacbench_rig.strokes import simulate
from touchgoal.control.features import (
    TACTILE_LEFT,
    TACTILE_RIGHT,
    TRUTH_CONTACT,
    TRUTH_PAD_WRENCH,
    TRUTH_SUCCESS,
)
from touchgoal.episodes.slide_recording import Recorded, left_fingertip, record_rig, slide_episode
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.parallel.parallel_map import Workers

Recording = Literal["strokes", "slides", "grasps", "cloths"]
"""Content of a set: indenter strokes, slides of held shapes, grasp attempts of three frames, presses of
cloth."""


def record_bench(
    what: Recording, root: Path, config: RigConfig, count: int, workers: Workers
) -> EpisodeSet:
    """Record the first `count` episodes of a rig; see `record_rig`."""
    shapes = {"strokes": config.indenters, "slides": HELD}
    low, high = config.load
    loads = f"{low:g} to {high:g} N{', no relief' * (not config.shear_relief)}"
    rig = f"{config.sensor}, {'+'.join(shapes.get(what, (what,)))}, {loads}, seed {config.seed}"
    return record_rig(root, partial(_simulated, what, config), rig, count, workers)


def _simulated(what: Recording, config: RigConfig, index: int) -> Recorded:
    simulators = {"strokes": _stroke, "slides": _slide, "grasps": _grasp, "cloths": _cloth}
    frames, task, meta = simulators[what](config, index)
    return frames, task, {"sensor": config.sensor, **meta}


def _stroke(config: RigConfig, index: int) -> Recorded:
    stroke = simulate(config, index)
    load, friction = float(stroke.load), float(stroke.friction)
    return (
        left_fingertip(stroke.frames, stroke.wrench, stroke.slip),
        f"press a {stroke.indenter} probe into the sensor and slide it",
        {"object": stroke.indenter, "load": load, "friction": friction},
    )


def _slide(config: RigConfig, index: int) -> Recorded:
    return slide_episode(simulate_slide(config, index))


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

"""What the first look of pick-and-place finds under changes of the scene and of the image.

Nothing moves. A look is right if object and disc are found to 2 cm. A camera that stands elsewhere is calibrated,
with an error of 5 mm and 1 degree (RMS).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np

from benchmarks.options import CORES, BenchmarkOptions
from touchgoal.control import features as ft
from touchgoal.policies.acting import one_thread
from touchgoal.policies.checkpoint import ESTIMATOR, SHIPPED_POLICIES
from touchgoal.policies.perception.known_names import NAMES
from touchgoal.policies.perception.state_estimation import StateEstimator, load_pose_estimator
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import USUAL_CAMERA, PickPlaceConfig, SceneConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.lighting import Lighting
from touchgoal.sim_envs.scene.variety import moved_camera

_RIGHT = 20.0  # mm
_NOISE = 12.0  # grey levels
Spec = mujoco.MjSpec


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark first-look."""

    estimator: Path = SHIPPED_POLICIES["pick-place"] / ESTIMATOR
    """Folder of a pose estimator."""
    changes: tuple[str, ...] = ()
    """Changes to try, such as "blue table"; default: all."""
    looks: Count = 15
    """Looks under each change, at scenes drawn anew."""
    seed: Seed = seeds.POLICY_TEST.start + 300_000
    """Random seed of the first scene; each further one adds one."""
    workers: Count = CORES
    """Processes that render."""


@dataclass(frozen=True)
class _Change:
    """One change of the environment, of the scene's spec, of the image, or of what is asked for."""

    env: dict[str, Any]
    scene: Callable[[Spec], None] | None = None
    image: Callable[[np.ndarray], np.ndarray] | None = None
    target: str = ""  # {object}: name of the object meant; {absent}: of one that is not there
    nothing: bool = False  # whether nothing can be right, so that only a refusal is


def changed_camera(
    shift: tuple[float, float, float] = (0, 0, 0),
    turn: tuple[float, float, float] = (0, 0, 0),
    fovy: float = USUAL_CAMERA[-1],
) -> dict[str, Any]:
    """Return the option of a camera shifted (m) and turned (roll, pitch, yaw, degrees) from the usual one."""
    place = np.add(USUAL_CAMERA[:3], shift)
    return {"front_camera": moved_camera(USUAL_CAMERA, place, turn, fovy)}


def _painted(name: str, *rgb: float) -> Callable[[Spec], None]:
    def change(spec: Spec) -> None:
        spec.geom(name).rgba[:] = *rgb, 1

    return change


def _check_table(spec: Spec) -> None:
    spec.add_texture(
        name="cloth", type=mujoco.mjtTexture.mjTEXTURE_2D, width=256, height=256,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER, rgb1=[0.75] * 3, rgb2=[0.35] * 3,
    )  # fmt: skip
    material = spec.add_material(name="cloth", texrepeat=[8, 8])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "cloth"
    spec.geom("table").material = "cloth"
    spec.geom("table").rgba[:] = 1


def _sized(radius: float) -> Callable[[Spec], None]:
    def change(spec: Spec) -> None:
        spec.geom("goal").size[:] = radius, 0.0005, 0

    return change


def _noisy(image: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, _NOISE, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8)


def _compressed(image: np.ndarray) -> np.ndarray:
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 40])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_UNCHANGED))


def _half_covered(image: np.ndarray) -> np.ndarray:
    return np.concatenate([np.full_like(image[: len(image) // 2], 90), image[len(image) // 2 :]])


CHANGES = {
    "unchanged": _Change({}),
    "camera rolled 5 degrees": _Change(changed_camera(turn=(5, 0, 0))),
    "camera rolled 30 degrees": _Change(changed_camera(turn=(30, 0, 0))),
    "camera pitched 5 degrees up": _Change(changed_camera(turn=(0, 5, 0))),
    "camera 8 cm aside": _Change(changed_camera((0.0, 0.08, 0.0))),
    "camera 20 cm back": _Change(changed_camera((0.17, 0.0, 0.1))),
    "camera 15 cm higher": _Change(changed_camera((0.0, 0.0, 0.15), (0, -9, 0))),
    "lens of 36 degrees": _Change(changed_camera(fovy=36.0)),
    "lens of 60 degrees": _Change(changed_camera(fovy=60.0)),
    "lamp 1 m off": _Change({"lighting": Lighting(lamp_shift=(-1.0, 0.0, 0.0))}),
    "room twice as bright": _Change({"lighting": Lighting(room_light=1.0)}),
    "brown table": _Change({}, _painted("table", 0.45, 0.3, 0.2)),
    "blue table": _Change({}, _painted("table", 0.2, 0.3, 0.6)),
    "white table": _Change({}, _painted("table", 0.95, 0.95, 0.95)),
    "black table": _Change({}, _painted("table", 0.06, 0.06, 0.06)),
    "checked table": _Change({}, _check_table),
    "red disc": _Change({}, _painted("goal", 0.7, 0.15, 0.1)),
    "blue disc": _Change({}, _painted("goal", 0.1, 0.2, 0.7)),
    "disc of 9 cm": _Change({}, _sized(0.045)),
    "disc of 4 cm": _Change({}, _sized(0.02)),
    "noise": _Change({}, image=_noisy),
    "JPEG at quality 40": _Change({}, image=_compressed),
    "upper half covered": _Change({}, image=_half_covered, nothing=True),
    "mirrored": _Change({}, image=lambda image: np.ascontiguousarray(image[:, ::-1]), nothing=True),
    "two others, no name": _Change({"distractors": 2}, nothing=True),
    "two others, the object's name": _Change({"distractors": 2}, target="the {object}"),
    "two others, another object's name": _Change(
        {"distractors": 2}, target="the {absent}", nothing=True
    ),
    "two others, an unknown name": _Change(
        {"distractors": 2}, target="the green teapot", nothing=True
    ),
}


class _Changed(PickPlace):
    """Pick-and-place with a changed scene."""

    def __init__(self, config: PickPlaceConfig, change: Callable[[Spec], None] | None) -> None:
        self._change = change
        super().__init__(config)

    def scene(self, config: SceneConfig) -> Spec:
        spec = super().scene(config)
        if self._change is not None:
            self._change(spec)
        return spec


def run(config: Config) -> dict[str, Any]:
    """Look under every change, and return the table."""
    jobs = list(config.changes or CHANGES)
    if unknown := set(jobs) - set(CHANGES):
        raise UserError(f"there is no change '{unknown.pop()}'; choose from: {', '.join(CHANGES)}")
    with parallel_map(partial(_look, config), jobs, config.workers) as results:
        found = dict(zip(jobs, track(results, "looking", "change", total=len(jobs)), strict=True))
    lines = [f"{'':<40}{'right':>6}{'refused':>9}{'wrong':>7}{'object, disc mm (median)':>28}"]
    rows = []
    for name, looks in found.items():
        refused = looks.count(None)
        seen = 1e3 * np.array([look for look in looks if look is not None])
        right = 0 if CHANGES[name].nothing else int((seen.reshape(-1, 2) <= _RIGHT).all(1).sum())
        middle = "{:.0f}, {:.0f}".format(*np.median(seen, axis=0)) if len(seen) else ""
        wrong = len(looks) - right - refused
        lines.append(f"{name:<40}{right:>6}{refused:>9}{wrong:>7}{middle:>28}")
        rows.append({"what": name, "right": right, "refused": refused, "wrong": wrong})
    return {"table": "\n".join(lines), "looks": config.looks, "rows": rows}


def _look(config: Config, name: str) -> list[tuple[float, float] | None]:
    """Return the errors of object and disc in the plane (m) under a change; None where it is refused."""
    change, network = CHANGES[name], load_pose_estimator(config.estimator)
    task = PickPlaceConfig(
        tactile=False, cameras=("front",), camera_size=network.config.size, as_deployed=True
    )
    env = _Changed(replace(task, **change.env), change.scene)
    looks: list[tuple[float, float] | None] = []
    for seed in range(config.seed, config.seed + config.looks):
        first, _ = env.reset(seed=seed)
        image = first[ft.FRONT]
        first = {**first, ft.FRONT: image if change.image is None else change.image(image)}
        first |= dict.fromkeys(ft.TACTILE, np.zeros((8, 8, 3), np.uint8))
        there = [body.kind.name.replace("_", " ") for body in env.bodies]
        absent = next(n for n in NAMES[seed % len(NAMES) :] + NAMES if n not in there)
        target = change.target.format(object=there[0], absent=absent)
        estimator = StateEstimator(network, target, env.calibrated_camera())
        try:
            with one_thread():
                found = estimator.estimate(first, first)[ft.TRUTH_START]
        except UserError:
            looks.append(None)
            continue
        off = found - env.start_of("object")
        looks.append((float(np.linalg.norm(off[:2])), float(np.linalg.norm(off[5:]))))
    env.close()
    return looks

"""Rendered starts of pick-place, on which the pose estimator is trained."""

from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.policies.perception.target_words import COLOURS, Appearance, sentence
from touchgoal.policies.perception.usual_view import UsualView
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import USUAL_CAMERA, PickPlaceConfig, SceneConfig
from touchgoal.sim_envs.pick_place import WORKSPACE, Hand, PickPlace
from touchgoal.sim_envs.scene.lighting import USUAL, UsualLight, draw_lighting
from touchgoal.sim_envs.scene.variety import (
    CALIBRATION_ERROR,
    cover_table,
    draw_near_placement,
    draw_placement,
    measured_placement,
    paint,
    place_camera,
)

MOST = 4  # objects on the table
_ALONE = 0.4  # share of the placements with one object
_BESIDE, _OVER, _ANYWHERE = 0.06, (0.05, 0.2), (0.06, 0.34)  # m, of a hand and its TCP's height
_COLOUR_NOISE = 0.04  # standard deviation of a painted colour, of [0, 1]


@dataclass(frozen=True)
class Variety:
    """Shares of varied placements, or objects."""

    painted: float = 0.5  # objects of another colour than their kind's
    covered: float = 0.4  # scenes whose table has a pattern
    repainted: float = 0.5  # placements with table and disc of any colour, and a disc of any size
    elsewhere: float = 0.4  # placements seen by a calibrated camera that stands elsewhere
    changed: float = 0.7  # others with the camera moved a little; with another light, as all these
    hand_anywhere: float = 0.2  # placements with the hand anywhere over the table
    hand_over: float = 0.3  # placements with it over an object, as when an episode looks again


NO_VARIETY = Variety(*[0.0] * len(fields(Variety)))


@dataclass(frozen=True, eq=False)
class Placements:
    """Starts of n episodes, each with up to k objects on the table, any of which may be the target.

    A missing object, or one that no sentence distinguishes from the others, has sentence -1.
    """

    images: dict[str, UInt8[Tensor, "n h w 3"]]  # camera images by column
    tcp: Float32[Tensor, "n 7"]  # pose of the hand, `features.TCP_POSE`
    shift: Float32[Tensor, "n 3"]  # of the calibrated front camera from the usual one, m
    start: Float32[Tensor, "n k 7"]  # true poses with each as target, `features.TRUTH_START`
    # of each object's centre, and last of the goal's, in each camera image: row and column, px
    pixels: dict[str, Float32[Tensor, "n k+1 2"]]
    objects: Int64[Tensor, " n"]  # number of objects on the table; they come first of the k
    sentence: Int64[Tensor, "n k"]  # row in `sentences`
    sentences: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.start)


def render_placements(
    config: PickPlaceConfig,
    scenes: int,
    placements_each: int,
    seed: int,
    workers: int,
    variety: Variety = Variety(),
) -> Placements:
    """Render scenes of objects of random shape and size, each at several places.

    Seeds count up from `seed`.
    """
    config = replace(config, distractors=MOST - 1)
    seeds = range(seed, seed + scenes)
    keys = [ft.IMAGE_PREFIX + camera for camera in config.cameras]
    shape = scenes * placements_each, *config.camera_size, 3
    images = {key: torch.empty(shape, dtype=torch.uint8) for key in keys}
    rows: list[dict[str, Any]] = []
    with parallel_map(
        partial(_render_scene, config, placements_each, variety), seeds, workers
    ) as some:
        for row in chain.from_iterable(track(some, "rendering", "scene", total=scenes)):
            for key in keys:  # the only large arrays, so no second copy
                images[key][len(rows)] = torch.from_numpy(row.pop(key))
            rows.append(row)
    sentences = sorted({words for row in rows for words in row["words"] if words})
    number = {words: i for i, words in enumerate(sentences)} | {None: -1}
    return Placements(
        images=images,
        tcp=_column(rows, ft.TCP_POSE),
        shift=_column(rows, "shift"),
        start=_column(rows, "start"),
        pixels={key: _column(rows, f"pixels.{key}") for key in keys},
        objects=torch.tensor([row["objects"] for row in rows]),
        sentence=torch.tensor([[number[words] for words in row["words"]] for row in rows]),
        sentences=tuple(sentences),
    )


def _column(rows: list[dict[str, Any]], key: str) -> Tensor:
    return torch.from_numpy(np.stack([row[key] for row in rows]))


class _CoveredTable(PickPlace):
    """Pick-and-place on a table with a pattern."""

    def scene(self, config: SceneConfig) -> Any:
        spec = super().scene(config)
        cover_table(spec, self.np_random)
        return spec


def _render_scene(
    config: PickPlaceConfig, placements_each: int, variety: Variety, seed: int
) -> list[dict[str, Any]]:
    covered = np.random.default_rng(seed).random() < variety.covered
    env = (_CoveredTable if covered else PickPlace)(config)
    env.reset(seed=seed)
    rng = env.np_random.spawn(1)[0]
    light, rows = UsualLight.of(env.model), []
    camera = config.front_camera or USUAL_CAMERA
    looks = [env.model.geom("table").rgba, env.model.geom("goal").rgba, env.model.geom("goal").size]
    usual = [look.copy() for look in looks]
    for _ in range(placements_each):
        elsewhere = rng.random() < variety.elsewhere
        changed = elsewhere or rng.random() < variety.changed
        light.change(env.model, draw_lighting(rng) if changed else USUAL)
        near = draw_near_placement(camera, rng) if changed else camera
        placement = draw_placement(camera, WORKSPACE, rng) if elsewhere else near
        place_camera(env.model.camera("front"), placement)
        for look, before in zip(looks, usual, strict=True):
            look[:] = before
        if rng.random() < variety.repainted:
            paint(env.model, rng)
        rows.append(_render_placement(env, rng, variety, elsewhere))
    env.close()
    return rows


def _render_placement(
    env: PickPlace, rng: np.random.Generator, variety: Variety, elsewhere: bool
) -> dict[str, Any]:
    """Paint some objects, hide others, move all of them, and render them."""
    count = 1 if rng.random() < _ALONE else int(rng.integers(2, MOST + 1))
    order = rng.permutation(MOST)
    shown = [env.bodies[i] for i in order[:count]]
    looks = []
    for body in env.bodies:
        rgb, painted = np.array(body.kind.material.rgba[:3]), bool(rng.random() < variety.painted)
        if painted:
            name = list(COLOURS)[rng.integers(len(COLOURS))]
            rgb = np.clip(rng.normal(COLOURS[name], _COLOUR_NOISE), 0, 1)
        env.model.geom(body.name).rgba[:] = *rgb, float(body in shown)
        if body in shown:
            looks.append(Appearance(body.kind, rgb, painted))
    shown.sort(key=env.bodies.index)
    observation, _ = env.rearrange(_draw_hand(env, rng, order[:count], variety))
    row: dict[str, Any] = dict(observation)
    starts = np.stack([env.start_of(body.name) for body in shown])
    row["start"], row["objects"] = _padded(starts), count
    points = [*starts[:, :3], np.append(env.goal, 0.0)]
    for camera in env.config.cameras:
        key = ft.IMAGE_PREFIX + camera
        seen = np.stack([_pixel(env, camera, point) for point in points])
        row[f"pixels.{key}"] = np.concatenate([_padded(seen[:-1]), seen[-1:].astype(np.float32)])
    row["shift"] = np.zeros(3, np.float32)
    if elsewhere:
        _see_as_usual(row, env, rng)
    words = [sentence(rng, look, [*looks[:i], *looks[i + 1 :]]) for i, look in enumerate(looks)]
    row["words"] = [*words, *[None] * (MOST - count)]
    return row


def _see_as_usual(row: dict[str, Any], env: PickPlace, rng: np.random.Generator) -> None:
    """Replace the front image by what the usual camera would see, by the camera's calibration."""
    here = measured_placement(env.model, env.data, CALIBRATION_ERROR, rng)
    usual, pixels = env.config.front_camera or USUAL_CAMERA, f"pixels.{ft.FRONT}"
    view, image = UsualView(usual, here, env.config.camera_size), row[ft.FRONT]
    row[pixels] = np.stack([view.seen(place, image) for place in row[pixels]]).astype(np.float32)
    row[ft.FRONT], row["shift"] = view(image), view.shift.astype(np.float32)


def _draw_hand(
    env: PickPlace, rng: np.random.Generator, shown: Int64[np.ndarray, " s"], variety: Variety
) -> Hand | None:
    """Draw where the hand is; None: where it usually starts."""
    kind, turn = rng.random(), rng.uniform(-np.pi / 2, np.pi / 2)

    def joints(objects: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " j"]:
        at, heights = rng.uniform(*np.array(WORKSPACE).T), _ANYWHERE
        if kind < variety.hand_over:
            at = objects[rng.choice(shown)] + rng.uniform(-_BESIDE, _BESIDE, 2)
            heights = _OVER
        position = np.append(at, rng.uniform(*heights))
        return env.kinematics.solve_ik(position, fingers_down(turn), env.robot.arm.home)

    return joints if kind < variety.hand_over + variety.hand_anywhere else None


def _padded(rows: Float[np.ndarray, "m d"]) -> Float32[np.ndarray, "k d"]:
    padded = np.zeros((MOST, rows.shape[1]), np.float32)
    padded[: len(rows)] = rows
    return padded


def _pixel(env: PickPlace, camera: str, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2"]:
    """Return the row and column (px) where a camera sees a point of the base frame (m)."""
    at, (rows, columns) = env.data.camera(camera), env.config.camera_size
    x, y, z = at.xmat.reshape(3, 3).T @ (point - at.xpos)  # x right, y up, z back
    focal = rows / 2 / np.tan(np.radians(env.model.camera(camera).fovy[0]) / 2)  # px
    return np.array([rows / 2 + focal * y / z, columns / 2 - focal * x / z])

"""Rendered starts of pick-place, on which the pose estimator is trained."""

from dataclasses import dataclass, replace
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
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import WORKSPACE, Hand, PickPlace
from touchgoal.sim_envs.scene.surroundings import USUAL, UsualScene, draw_surroundings

MOST = 4  # objects on the table
_ALONE = 0.4  # share of the placements with one object
_BESIDE, _OVER, _ANYWHERE = 0.06, (0.05, 0.2), (0.06, 0.34)  # m, of a hand and its TCP's height
_COLOUR_NOISE = 0.04  # standard deviation of a painted colour, of [0, 1]


@dataclass(frozen=True)
class Variety:
    """Shares of varied placements, or objects."""

    painted: float = 0.5  # objects of another colour than their kind's
    surroundings: float = 0.7  # placements with another camera pose and light
    hand_anywhere: float = 0.2  # placements with the hand anywhere over the table
    hand_over: float = 0.3  # placements with it over an object, as when an episode looks again


@dataclass(frozen=True, eq=False)
class Placements:
    """Starts of n episodes, each with up to k objects on the table, any of which may be the target.

    A missing object, or one that no sentence distinguishes from the others, has sentence -1.
    """

    images: dict[str, UInt8[Tensor, "n h w 3"]]  # camera images by column
    tcp: Float32[Tensor, "n 7"]  # pose of the hand, `features.TCP_POSE`
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
        start=_column(rows, "start"),
        pixels={key: _column(rows, f"pixels.{key}") for key in keys},
        objects=torch.tensor([row["objects"] for row in rows]),
        sentence=torch.tensor([[number[words] for words in row["words"]] for row in rows]),
        sentences=tuple(sentences),
    )


def _column(rows: list[dict[str, Any]], key: str) -> Tensor:
    return torch.from_numpy(np.stack([row[key] for row in rows]))


def _render_scene(
    config: PickPlaceConfig, placements_each: int, variety: Variety, seed: int
) -> list[dict[str, Any]]:
    env = PickPlace(config)
    env.reset(seed=seed)
    rng = env.np_random.spawn(1)[0]
    scene, rows = UsualScene.of(env.model), []
    for _ in range(placements_each):
        changed = rng.random() < variety.surroundings
        scene.change(env.model, draw_surroundings(rng) if changed else USUAL)
        rows.append(_render_placement(env, rng, variety))
    env.close()
    return rows


def _render_placement(env: PickPlace, rng: np.random.Generator, variety: Variety) -> dict[str, Any]:
    """Paint some objects, hide others, move all of them, and render them."""
    count = 1 if rng.random() < _ALONE else int(rng.integers(2, MOST + 1))
    order = rng.permutation(MOST)
    shown = [env.bodies[i] for i in order[:count]]
    looks = []
    for body in env.bodies:
        rgb, paint = np.array(body.kind.material.rgba[:3]), bool(rng.random() < variety.painted)
        if paint:
            name = list(COLOURS)[rng.integers(len(COLOURS))]
            rgb = np.clip(rng.normal(COLOURS[name], _COLOUR_NOISE), 0, 1)
        env.model.geom(body.name).rgba[:] = *rgb, float(body in shown)
        if body in shown:
            looks.append(Appearance(body.kind, rgb, paint))
    shown.sort(key=env.bodies.index)
    observation, _ = env.rearrange(_draw_hand(env, rng, order[:count], variety))
    row: dict[str, Any] = dict(observation)
    starts = np.stack([env.start_of(body.name) for body in shown])
    row["start"], row["objects"] = _padded(starts), count
    goal = np.append(env.goal, 0.0)
    for camera in env.config.cameras:
        seen = np.stack([_pixel(env, camera, pose[:3]) for pose in starts])
        both = np.concatenate([_padded(seen), _pixel(env, camera, goal)[None]])
        row[f"pixels.{ft.IMAGE_PREFIX}{camera}"] = both.astype(np.float32)
    words = [sentence(rng, look, [*looks[:i], *looks[i + 1 :]]) for i, look in enumerate(looks)]
    row["words"] = [*words, *[None] * (MOST - count)]
    return row


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

"""Rendered starts of pick-place, on which the pose estimator is trained."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace


@dataclass(frozen=True, eq=False)
class Placements:
    """Starts of n episodes."""

    pictures: dict[str, UInt8[Tensor, "n h w 3"]]  # camera images by column
    tcp: Float32[Tensor, "n 7"]  # pose of the hand, `features.TCP_POSE`
    start: Float32[Tensor, "n 7"]  # true poses, `features.TRUTH_START`

    def __len__(self) -> int:
        return len(self.start)


def render_placements(
    config: PickPlaceConfig, objects: int, placements_each: int, seed: int, workers: int
) -> Placements:
    """Render objects of random shape and size, one for each seed from `seed` on, at several places."""
    seeds = range(seed, seed + objects)
    render = partial(_render_object, config, placements_each)
    with parallel_map(render, seeds, workers) as rendered:
        rows = [
            row for some in track(rendered, "rendering", "object", total=objects) for row in some
        ]
    keys = [key for key in ft.CAMERAS if key in rows[0]]
    columns = {
        key: torch.from_numpy(np.stack([row[key] for row in rows]))
        for key in (*keys, ft.TCP_POSE, ft.TRUTH_START)
    }
    tcp, start = columns.pop(ft.TCP_POSE), columns.pop(ft.TRUTH_START)
    return Placements(columns, tcp, start)


def _render_object(
    config: PickPlaceConfig, placements_each: int, seed: int
) -> list[dict[str, np.ndarray]]:
    env = PickPlace(config)
    observation, info = env.reset(seed=seed)
    rows = [observation | info]
    for _ in range(placements_each - 1):
        observation, info = env.rearrange()
        rows.append(observation | info)
    env.close()
    return rows

"""Fitting of a `Value` on successful episodes."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float16
from torch import Tensor

from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.value.value import Value, ValueConfig
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

LEAST_EPISODES = 4
_STEPS, _BATCH = 1000, 128  # "off" of objects not fitted: AUC .90, after 400 steps .78
_MOST_FRAMES = 8192  # of all episodes: 0.7 GB of maps
_LEARNING_RATE, _WEIGHT_DECAY = 3e-3, 1.0  # the same with 5: .81, with 20: .71


def fit_value(episodes: Sequence[EmbeddedEpisode], task: str, seed: int = 0) -> Value:
    """Fit on successes: the target of frame t of T is t / (T - 1).

    UserError: fewer than 4 episodes, or one without the maps of all cameras.
    """
    keys = _check(episodes)
    step = -(-sum(len(e) for e in episodes) // _MOST_FRAMES)
    maps = torch.from_numpy(np.concatenate([_maps(e, keys)[::step] for e in episodes]))
    target = torch.cat([torch.linspace(0, 1, len(e))[::step] for e in episodes])
    first = episodes[0].cameras[keys[0]].map
    assert first is not None  # checked
    channels, rows, columns = first.shape[1:]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        config = ValueConfig(
            task, keys, episodes[0].made_with.towers, (channels, rows, columns), len(episodes)
        )
        value = Value(config)
        value.mean.copy_(maps.float().mean((0, 3))[..., None])
        value.spread.copy_(maps.float().std((0, 3))[..., None] + 1e-6)
        _regress(value, maps, target)
    return value.eval().requires_grad_(False)


def _regress(
    value: Value, maps: Float16[Tensor, "n cameras c yx"], target: Float[Tensor, " n"]
) -> None:
    """Minimise the squared error of all heads, on the same batches."""
    optimizer = torch.optim.AdamW(value.parameters(), _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, _STEPS)
    for _ in track(range(_STEPS), "fitting the value", "step"):
        batch = torch.randint(len(maps), (_BATCH,))
        loss = (value(maps[batch].float()) - target[batch]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()


def _check(episodes: Sequence[EmbeddedEpisode]) -> tuple[str, ...]:
    """Return the keys of the cameras that a value looks through."""
    if len(episodes) < LEAST_EPISODES:
        raise UserError(
            f"a value needs at least {LEAST_EPISODES} successful episodes, these are {len(episodes)}"
        )
    keys = tuple(episodes[0].cameras)
    for e in episodes:
        if not keys or any(key not in e.cameras or e.cameras[key].map is None for key in keys):
            raise UserError(
                f"{e.source} has no feature maps of {' and '.join(keys) or 'a camera'}: a value "
                "needs the offline towers and the same cameras in every episode"
            )
    return keys


def _maps(episode: EmbeddedEpisode, keys: Sequence[str]) -> Float16[np.ndarray, "n cameras c yx"]:
    maps = [m for key in keys if (m := episode.cameras[key].map) is not None]
    together = np.stack(maps, axis=1)
    return together.reshape(*together.shape[:3], -1)

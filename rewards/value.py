"""Value of a task: its progress as seen in one image, learned from successful episodes alone.

Attention pooling with 4 heads over the maps of all cameras (stride 16, from a frozen tower) and a
linear read-out, regressed on t / T; the mean of three seeds. It tells progress between contact and
goal, where distances to a goal say little. It looks at one frame at a time and does not read the
goal: it holds for the task, cameras and towers that it was fitted to, and is refused elsewhere.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float16
from torch import Tensor, nn

from touchgoal.control.features import IMAGE_PREFIX
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.rewards.features.embedded import EmbeddedEpisode, Features, cameras_of, map_name
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

VALUE_FORMAT = WeightsFormat("value", "value", "fit one with touchgoal fit-normalizer --value")
REMEDY = "fit another with touchgoal fit-normalizer --value, or move value.json away"
LEAST_EPISODES = 4
_HEADS = 4
_CHUNK = 256  # frames in float32 at once
_STEPS, _BATCH = 1000, 128  # "off" of objects not fitted: AUC .90, after 400 steps .78
_MOST_FRAMES = 8192  # of all episodes: 0.7 GB of maps
_LEARNING_RATE, _WEIGHT_DECAY = 3e-3, 1.0  # the same with 5: .81, with 20: .71


@dataclass(frozen=True)
class ValueConfig:
    """Task, cameras and image network that a value was fitted to."""

    task: str  # see `Inputs.fitted_task`
    cameras: tuple[str, ...]  # keys, in the order of the maps
    towers: str  # `EmbeddingSource.towers`
    shape: tuple[int, int, int]  # of a map: channels, rows, columns
    episodes: int  # number of successes
    seeds: int = 3  # heads whose mean counts


class ValueHead(nn.Module):
    """One seed: pooled over both cameras' positions, then linear."""

    def __init__(self, config: ValueConfig) -> None:
        super().__init__()
        cameras, (channels, rows, columns) = len(config.cameras), config.shape
        self.query = nn.Parameter(torch.randn(cameras, _HEADS, channels) / channels**0.5)
        self.place = nn.Parameter(torch.zeros(cameras, _HEADS, rows * columns))
        self.read = nn.Linear(cameras * _HEADS * channels, 1)

    def forward(self, maps: Float[Tensor, "n cameras c yx"]) -> Float[Tensor, " n"]:
        """Return the predicted progress, about 0 to 1."""
        scores = torch.einsum("khc,nkcp->nkhp", self.query, maps) + self.place
        pooled = torch.einsum("nkhp,nkcp->nkhc", scores.softmax(-1), maps)
        return self.read(pooled.flatten(1))[:, 0]


class Value(nn.Module):
    """Mean of several heads on maps standardised by channel."""

    mean: Float[Tensor, "cameras c 1"]
    spread: Float[Tensor, "cameras c 1"]

    def __init__(self, config: ValueConfig) -> None:
        super().__init__()
        self.config = config
        shape = len(config.cameras), config.shape[0], 1
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("spread", torch.ones(shape))
        self.heads = nn.ModuleList(ValueHead(config) for _ in range(config.seeds))

    def forward(self, maps: Float[Tensor, "n cameras c yx"]) -> Float[Tensor, "seeds n"]:
        """Return each head's prediction."""
        standardised = (maps - self.mean) / self.spread
        return torch.stack([head(standardised) for head in self.heads])

    @torch.no_grad()
    def progress(self, features: Features) -> Float[np.ndarray, " n"]:
        """Return the predicted progress at each frame, from that frame alone, in [0, 1]."""
        maps = torch.from_numpy(_stacked(features, self.config.cameras))
        chunks = [self(some.float()) for some in maps.split(_CHUNK)]
        return torch.cat([c.mean(0) for c in chunks]).clamp(0, 1).numpy().astype(np.float64)

    def mismatch(self, task: str, cameras: tuple[str, ...], towers: str) -> str | None:
        """Return why the value does not hold for a trajectory; None if it does."""
        mine = self.config
        if task != mine.task:
            return f"it was fitted to the task '{mine.task}', not '{task}'"
        if missing := [key for key in mine.cameras if key not in cameras]:
            return f"it looks through {' and '.join(missing)}, which is not there"
        if towers != mine.towers:
            return f"it was fitted with the towers {mine.towers}, not {towers}"
        return None

    def save(self, folder: Path, provenance: dict[str, Any]) -> None:
        """Write value.safetensors and value.json."""
        VALUE_FORMAT.save(folder, self.state_dict(), asdict(self.config), provenance)

    @classmethod
    def load(cls, folder: Path) -> "Value":
        """Read what `save` wrote; UserError if it is missing or damaged."""
        value = cls(VALUE_FORMAT.read_config(folder, ValueConfig))
        VALUE_FORMAT.load_weights(value, folder)
        return value


def fit_value(episodes: Sequence[EmbeddedEpisode], task: str) -> Value:
    """Fit on successes: the target of frame t of T is t / (T - 1).

    UserError: fewer than 4 episodes, or one without the maps of all cameras.
    """
    if len(episodes) < LEAST_EPISODES:
        raise UserError(
            f"a value needs at least {LEAST_EPISODES} successful episodes, these are {len(episodes)}"
        )
    names = cameras_of(episodes[0].features)
    for e in episodes:
        if not names or any(map_name(name) not in e.features for name in names):
            raise UserError(
                f"{e.source} has no feature maps of {' and '.join(names) or 'a camera'}: a value "
                "needs the offline towers and the same cameras in every episode"
            )
    keys = tuple(IMAGE_PREFIX + name for name in names)
    step = -(-sum(len(e) for e in episodes) // _MOST_FRAMES)
    maps = torch.from_numpy(np.concatenate([_stacked(e.features, keys)[::step] for e in episodes]))
    target = torch.cat([torch.linspace(0, 1, len(e))[::step] for e in episodes])
    shape = episodes[0].features[map_name(keys[0])].shape[1:]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        value = Value(ValueConfig(task, keys, episodes[0].made_with.towers, shape, len(episodes)))
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


def _stacked(features: Features, keys: Sequence[str]) -> Float16[np.ndarray, "n cameras c yx"]:
    """Return the maps of several cameras, positions flattened."""
    together = np.stack([features[map_name(key)] for key in keys], axis=1)
    return together.reshape(*together.shape[:3], -1)

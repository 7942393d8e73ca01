"""Value of a task: its progress as seen in one image, learned from successful episodes alone.

Attention pooling with 4 heads over the maps of all cameras (stride 16, from a frozen tower) and a
linear read-out, regressed on t / T; the mean of three seeds. It tells progress between contact and
goal, where distances to a goal say little. It looks at one frame at a time and does not read the
goal: it holds for the task, cameras and towers that it was fitted to, and is refused elsewhere.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.rewards.features.embedded import CameraFeatures

VALUE_FORMAT = WeightsFormat("value", "value", "fit one with touchgoal fit-normalizer --value")
REMEDY = "fit another with touchgoal fit-normalizer --value, or move value.json away"
_HEADS = 4
_CHUNK = 256  # frames in float32 at once


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
    def progress(self, cameras: Mapping[str, CameraFeatures]) -> Float[np.ndarray, " n"]:
        """Return the predicted progress at each frame, from that frame alone, in [0, 1]."""
        maps = stacked_maps(cameras, self.config.cameras)
        chunks = [self(torch.from_numpy(maps[i : i + _CHUNK])) for i in range(0, len(maps), _CHUNK)]
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
        value = cls(VALUE_FORMAT.read_config(folder, _config))
        VALUE_FORMAT.load_weights(value, folder)
        return value


def stacked_maps(
    cameras: Mapping[str, CameraFeatures], keys: tuple[str, ...]
) -> Float32[np.ndarray, "n cameras c yx"]:
    """Return the maps of several cameras, positions flattened."""
    maps = [features.map for key in keys if (features := cameras[key]).map is not None]
    together = np.stack(maps, axis=1).astype(np.float32)
    return together.reshape(*together.shape[:3], -1)


def _config(fields: dict[str, Any]) -> ValueConfig:
    cameras, shape = tuple(fields["cameras"]), tuple(fields["shape"])
    return ValueConfig(**{**fields, "cameras": cameras, "shape": shape})

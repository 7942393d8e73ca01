"""touchgoal's policies in lerobot: `--policy.type=touchgoal --policy.policy=pick-place`.

lerobot-train trains them on a set that touchgoal reads, too: `--policy.data` names its folder once more.
Touch is embedded against the same fingertip at the episode's start, which no batch holds; so the rows of a
batch are looked up there. Checkpoints hold the policy as touchgoal's commands take it, in `policy/`.
"""

import copy
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate.utils import send_to_device
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.factory import make_default_pre_post_processors
from torch import Tensor, nn

from touchgoal.control.features import IMAGE_PREFIX, Observation
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.checkpoint import ESTIMATOR, TOUCH, SavedPolicy, find_policy, save
from touchgoal.policies.training.sequence_dataset import SequenceDataset, load_recordings
from touchgoal.policies.training.train import BETAS, POLICY, WEIGHT_DECAY, make_batch, untrained

DATA_MISSING = "--policy.data=FOLDER names the set that lerobot loads, to train on it"
"""Message where it is not named."""


@PreTrainedConfig.register_subclass("touchgoal")
@dataclass
class TouchgoalConfig(PreTrainedConfig):
    """Options of a policy of touchgoal."""

    policy: str = "pick-place"
    """Name of a shipped policy, or the folder of one."""
    data: str = ""
    """To train: folder of the set that lerobot loads, the one with meta/info.json."""
    fresh: bool = False
    """Train random weights, on the policy's inputs and with its head; else train the policy further."""
    lr: float = 1e-4
    """Learning rate of AdamW."""
    device: str | None = "cpu"
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=dict)

    observation_delta_indices = reward_delta_indices = None

    @property
    def action_delta_indices(self) -> list[int]:
        """Ticks of a plan."""
        network = SavedPolicy(find_policy(self.policy)).network()
        return list(range(network.config.prediction_horizon))

    def validate_features(self) -> None:
        """Leave the check to the policy, which names what it misses."""

    def get_optimizer_preset(self) -> AdamWConfig:
        """Return AdamW as touchgoal trains with it."""
        return AdamWConfig(lr=self.lr, betas=BETAS, weight_decay=WEIGHT_DECAY)

    get_scheduler_preset = validate_features


class TouchgoalPolicy(PreTrainedPolicy):
    """A policy's network, and one `LearnedPolicy` with it for each environment of a batch."""

    config_class, name = TouchgoalConfig, "touchgoal"

    def __init__(self, config: TouchgoalConfig, **_: Any) -> None:
        super().__init__(config)
        self._saved = SavedPolicy(find_policy(config.policy))
        self.network = copy.deepcopy(self._saved.network()).requires_grad_()
        if config.fresh and not config.pretrained_path:
            self.network = untrained(self.network.config, self._windows, torch.initial_seed())
        self._actors: list[LearnedPolicy] = []

    @cached_property
    def _windows(self) -> SequenceDataset:
        """All windows of the set to train on; their rows are lerobot's `index`."""
        if not self.config.data:
            raise ValueError(DATA_MISSING)
        episodes, actor = EpisodeSet(Path(self.config.data)), self._saved()
        recorded = load_recordings(episodes, range(len(episodes)), actor.config, actor.touch)
        return SequenceDataset(recorded, actor.config)

    def get_optim_params(self) -> Iterator[nn.Parameter]:
        """Return the network's parameters."""
        return self.network.parameters()

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Any] | None]:
        """Return the loss on a batch of lerobot's; ValueError: it is not of the set in `data`."""
        rows = batch["index"].cpu()
        windows = make_batch(self._windows, rows)
        if not torch.equal(windows["actions"], batch["action"].float().cpu()):
            raise ValueError(f"lerobot loads another set than {self.config.data}: actions differ")
        on_device = send_to_device(windows, batch["action"].device)
        noise = BatchNoise(torch.default_generator)
        return self.network(**on_device, noise=noise)["loss"], None

    def _save_pretrained(self, save_directory: Path, state_dict: Any = None) -> None:
        super()._save_pretrained(save_directory, state_dict)
        folder = save_directory / POLICY
        save(self.network, folder, {"from": self.config.policy, "data": self.config.data})
        for part in (TOUCH, ESTIMATOR):
            if (known := self._saved.directory / part).exists():
                shutil.copytree(known, folder / part, dirs_exist_ok=True)

    def reset(self) -> None:
        """Begin an episode in every environment."""
        self._actors = []

    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return an action of every environment, (b, 8): joint changes, rad, and width, m."""
        return torch.from_numpy(np.stack([actor.act(seen) for actor, seen in self._seen(batch)]))

    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return a plan of every environment, (b, h, 8), as if all had been still before."""
        plans = [actor.plan([seen] * actor.history_ticks) for actor, seen in self._seen(batch)]
        return torch.from_numpy(np.stack(plans))

    def _seen(self, batch: dict[str, Any]) -> Iterator[tuple[LearnedPolicy, Observation]]:
        """Yield the policy of each environment, and what is observed there."""
        observed = {key: value for key, value in batch.items() if isinstance(value, Tensor)}
        for i in range(len(next(iter(observed.values())))):
            if i == len(self._actors):
                on_cpu = copy.deepcopy(self.network).cpu().eval()
                self._actors.append(self._saved(network=on_cpu))
            yield self._actors[i], {k: as_recorded(k, v[i]) for k, v in observed.items()}


def as_recorded(key: str, value: Tensor) -> np.ndarray:
    """Return a value as touchgoal observes it: images uint8 (..., h, w, 3), not float (..., 3, h, w)."""
    if key.startswith(IMAGE_PREFIX):
        return (255 * value).round().byte().movedim(-3, -1).contiguous().cpu().numpy()
    return value.float().cpu().numpy()


def make_touchgoal_pre_post_processors(
    config: TouchgoalConfig, dataset_stats: Any = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return lerobot's pipelines around the policy, which scale nothing: it normalises by itself."""
    return make_default_pre_post_processors(config, dataset_stats)

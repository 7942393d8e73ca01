"""touchgoal's policies in lerobot: `--policy.type=touchgoal --policy.policy=pick-place`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import (
    PolicyProcessorPipeline,
    policy_action_to_transition,
    transition_to_policy_action,
)
from torch import Tensor

from touchgoal.control.features import IMAGE_PREFIX
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.checkpoint import SavedPolicy, find_policy


@PreTrainedConfig.register_subclass("touchgoal")
@dataclass
class TouchgoalConfig(PreTrainedConfig):
    """Options of a policy that touchgoal trained; lerobot runs it and does not train it."""

    policy: str = "pick-place"
    """Name of a shipped policy, or the folder of one."""
    device: str | None = "cpu"

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def validate_features(self) -> None:
        """Leave the check to the policy, which names what it misses."""

    get_optimizer_preset = get_scheduler_preset = validate_features  # it is not trained here


class TouchgoalPolicy(PreTrainedPolicy):
    """One `LearnedPolicy` for each environment of a batch."""

    config_class, name = TouchgoalConfig, "touchgoal"

    def __init__(self, config: TouchgoalConfig, **_: Any) -> None:
        super().__init__(config)
        self._saved = SavedPolicy(find_policy(config.policy))
        self._actors: list[LearnedPolicy] = []

    def reset(self) -> None:
        """Begin an episode in every environment."""
        self._actors = []

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return an action of every environment, (b, 8): joint changes, rad, and width, m."""
        observed = {key: value for key, value in batch.items() if isinstance(value, Tensor)}
        rows = len(next(iter(observed.values())))
        self._actors += [self._saved() for _ in range(rows - len(self._actors))]
        actions = [
            actor.act({key: as_recorded(key, value[i]) for key, value in observed.items()})
            for i, actor in enumerate(self._actors)
        ]
        return torch.from_numpy(np.stack(actions))

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError("lerobot runs touchgoal's policies by select_action alone")

    forward = predict_action_chunk = get_optim_params = _refuse


def as_recorded(key: str, value: Tensor) -> np.ndarray:
    """Return a value as touchgoal observes it: images uint8 (..., h, w, 3), not float (..., 3, h, w)."""
    if key.startswith(IMAGE_PREFIX):
        return (255 * value).round().byte().movedim(-3, -1).contiguous().cpu().numpy()
    return value.float().cpu().numpy()


def make_touchgoal_pre_post_processors(
    config: TouchgoalConfig, dataset_stats: Any = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return lerobot's pipelines around the policy, which do nothing: it normalises by itself."""
    names = {"to_transition": policy_action_to_transition, "to_output": transition_to_policy_action}
    return PolicyProcessorPipeline(steps=[]), PolicyProcessorPipeline(steps=[], **names)

"""lerobot's ACT and diffusion policy, that feel: `--policy.type=act_touch`, or `diffusion_touch`.

A processor step puts frozen embeddings of both fingertips in place of their images, as `observation.environment_state`,
so that no network is trained on these. An embedding is relative to the same fingertip untouched, at the episode's start:
in training it is looked up in the set (`--policy.data`, its folder once more), in use it is the first image after a reset.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.processor.factory import make_default_pre_post_processors
from lerobot.processor.pipeline import ObservationProcessorStep
from lerobot.utils.constants import OBS_ENV_STATE
from lerobot_policy_touchgoal import DATA_MISSING, as_recorded
from torch import Tensor

from touchgoal.control.features import TACTILE
from touchgoal.episodes.store import EpisodeSet
from touchgoal.policies.perception.frozen_touch import TouchEmbedder, load_touch

Features = dict[str, PolicyFeature]


@dataclass
class _Touch:
    """Options of touch."""

    touch: str = "gelsight_mini"
    """Touch encoder: a name or a folder."""
    data: str = ""
    """To train: folder of the set that lerobot loads, the one with meta/info.json."""

    def validate_features(self) -> None:
        """Take embeddings in place of the fingertips' images, then check as lerobot does."""
        shape = load_touch(self.touch).shape
        self.input_features = {k: v for k, v in self.input_features.items() if k not in TACTILE}
        self.input_features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, shape)
        super().validate_features()  # pyright: ignore[reportAttributeAccessIssue]


@PreTrainedConfig.register_subclass("act_touch")
@dataclass
class ActTouchConfig(_Touch, ACTConfig):
    """Options of ACT with touch."""


@PreTrainedConfig.register_subclass("diffusion_touch")
@dataclass
class DiffusionTouchConfig(_Touch, DiffusionConfig):
    """Options of diffusion policy with touch."""


class ActTouchPolicy(ACTPolicy):
    """ACT, to which touch is the state of the environment."""

    config_class, name = ActTouchConfig, "act_touch"


class DiffusionTouchPolicy(DiffusionPolicy):
    """Diffusion policy, to which touch is the state of the environment."""

    config_class, name = DiffusionTouchConfig, "diffusion_touch"


@ProcessorStepRegistry.register("touchgoal_touch")
@dataclass
class TouchStep(ObservationProcessorStep):
    """Puts embeddings of both fingertips, (b, e) or (b, t, e), in place of their images."""

    touch: str
    data: str = ""
    _first: list[dict[str, np.ndarray]] = field(default_factory=list)  # by environment
    _untouched: dict[int, dict[str, np.ndarray]] = field(default_factory=dict)  # by episode

    @cached_property
    def _embedder(self) -> TouchEmbedder:
        return load_touch(self.touch)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Embed the fingertips; ValueError: one is missing."""
        if missing := [key for key in TACTILE if key not in observation]:
            raise ValueError(f"{missing[0]} is missing: touch needs the images of both fingertips")
        seen = {key: as_recorded(key, observation.pop(key)) for key in TACTILE}
        about = self._current_transition[TransitionKey.COMPLEMENTARY_DATA] or {}
        episodes: Tensor | None = about.get("episode_index")
        rows = [
            {key: images[i] for key, images in seen.items()} for i in range(len(seen[TACTILE[0]]))
        ]
        if episodes is None:
            self._first += rows[len(self._first) :]
            start = self._first[: len(rows)]
        else:
            start = [self._start(int(i)) for i in episodes]
        found = [self._embed(row, untouched) for row, untouched in zip(rows, start, strict=True)]
        observation[OBS_ENV_STATE] = torch.from_numpy(np.stack(found))
        return observation

    def _start(self, episode: int) -> dict[str, np.ndarray]:
        if episode not in self._untouched:
            if not self.data:
                raise ValueError(DATA_MISSING)
            frames = EpisodeSet(Path(self.data)).read(episode, TACTILE, [0]).frames
            self._untouched[episode] = {key: images[0] for key, images in frames.items()}
        return self._untouched[episode]

    def _embed(self, row: dict[str, np.ndarray], untouched: dict[str, np.ndarray]) -> np.ndarray:
        sides = []
        for key in TACTILE:
            images, before = row[key], untouched[key]
            several = images if images.ndim == 4 else images[None]
            embedded = self._embedder.encoder.embed_frames(several, before)
            sides.append(embedded if images.ndim == 4 else embedded[0])
        return np.concatenate(sides, -1)

    def reset(self) -> None:
        """Take the next images as those of the untouched fingertips."""
        self._first = []

    def get_config(self) -> dict[str, Any]:
        """Return what the step is made with."""
        return {"touch": self.touch, "data": self.data}

    def transform_features(self, features: Any) -> Any:
        """Return the features after the step."""
        return features


def make_act_touch_pre_post_processors(
    config: Any, dataset_stats: Any = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return lerobot's pipelines with the step before the device and the normalisation."""
    before, after = make_default_pre_post_processors(config, dataset_stats)
    before.steps = [*before.steps[:2], TouchStep(config.touch, config.data), *before.steps[2:]]
    return before, after


make_diffusion_touch_pre_post_processors = make_act_touch_pre_post_processors

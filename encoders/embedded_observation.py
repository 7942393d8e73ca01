"""Touch embeddings in place of tactile images in a Gymnasium environment's observations."""

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float32

from touchgoal.control.features import TACTILE
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import THRESHOLD, ContactDetector
from touchgoal.encoders.backbones.frame_history import RecentFrames
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.runtime.errors import UserError

TOUCH = "observation.touch"

Observation = dict[str, Any]


class EmbeddedTouch(gym.ObservationWrapper[Observation, np.ndarray, Observation]):
    """Replaces the tactile images by `observation.touch`: the left embedding, then the right one.

    An episode's first images, which are untouched, are the background. While a fingertip touches nothing its
    embedding is that of the first image, so that most ticks cost no network.
    """

    def __init__(self, env: gym.Env, encoder: AnyTouchEncoder) -> None:
        """Wrap an environment with both fingertips; UserError if it has none."""
        super().__init__(env)
        assert isinstance(env.observation_space, gym.spaces.Dict)
        spaces = dict(env.observation_space.items())
        if missing := [key for key in TACTILE if key not in spaces]:
            raise UserError(f"the environment has no {missing[0]} to embed: leave tactile on")
        self._encoder = encoder.eval()
        self._recent = {k: RecentFrames(encoder.preprocess, encoder.offsets) for k in TACTILE}
        self._ticks: deque[Observation] = deque(maxlen=1 + max(encoder.offsets))
        self._untouched: Observation = {}
        self._contact: dict[str, ContactDetector] = {}
        self._quiet: dict[str, int] = {}  # ticks since each fingertip touched something
        self._rest: dict[str, Float32[np.ndarray, " e"]] = {}  # their embeddings then
        width = len(TACTILE) * encoder.config.embedding_dim
        kept = {key: space for key, space in spaces.items() if key not in TACTILE}
        touch = gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.observation_space = gym.spaces.Dict(kept | {TOUCH: touch})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; its first images must be free of contact."""
        self._ticks.clear()
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Observation) -> Observation:
        """Return an observation with its touch embedded."""
        if not self._ticks:
            self._untouched = {key: observation[key] for key in TACTILE}
            self._contact = {
                key: ContactDetector(Background(observation[key][None]), THRESHOLD)
                for key in TACTILE
            }
            self._quiet, self._rest = dict.fromkeys(TACTILE, 0), {}
        self._ticks.append(observation)
        for key, contact in self._contact.items():
            self._quiet[key] = 0 if contact.update(observation[key]) else self._quiet[key] + 1
        seen = [k for k in TACTILE if not self._rest or self._quiet[k] < len(self._ticks)]
        embedded = {**self._rest, **(self._embed(seen) if seen else {})}
        self._rest = self._rest or embedded
        kept = {key: value for key, value in observation.items() if key not in TACTILE}
        return kept | {TOUCH: np.concatenate([embedded[key] for key in TACTILE])}

    @torch.no_grad()
    def _embed(self, keys: list[str]) -> dict[str, Float32[np.ndarray, " e"]]:
        frames = [
            self._recent[key].latest([tick[key] for tick in self._ticks], self._untouched[key])
            for key in keys
        ]
        found = self._encoder.embed_touch(self._encoder.stack(torch.cat(frames))).numpy()
        return dict(zip(keys, found, strict=True))

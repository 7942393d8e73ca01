"""Environments as reinforcement learning libraries expect them."""

from typing import Any

import cv2
import gymnasium as gym
import numpy as np

from touchgoal.control.features import IMAGE_PREFIX, TACTILE, TRUTH_SUCCESS
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv

TACTILE_SIZE = (60, 80)
"""Rows and columns of tactile images for RL: a quarter of the sensor's, to fit a replay buffer."""

Observation = dict[str, Any]
_OBSERVATION = "observation."


class ForRL(gym.ObservationWrapper[Observation, np.ndarray, Observation]):
    """Keys without dots, actions in [-1, 1], small tactile images, and `is_success` in `info`.

    "observation.images.front" becomes "front", "observation.state" becomes "state". An action of -1
    or 1 is a joint's speed limit, or the closed or open gripper.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        inner = env.unwrapped
        assert isinstance(inner, FrankaTactileEnv)
        assert isinstance(env.observation_space, gym.spaces.Dict)
        assert isinstance(inner.action_space, gym.spaces.Box)
        self._low, self._high = inner.action_space.low, inner.action_space.high
        self.action_space = gym.spaces.Box(-1.0, 1.0, self._low.shape, np.float32)
        small = gym.spaces.Box(0, 255, (*TACTILE_SIZE, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(
            {
                _short(key): small if key in TACTILE else space
                for key, space in env.observation_space.items()
            }
        )

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Run one control tick with an action in [-1, 1]; values beyond count as the limits."""
        share = (np.clip(action, -1.0, 1.0) + 1) / 2
        scaled = self._low + share * (self._high - self._low)
        observation, reward, terminated, truncated, info = super().step(scaled)
        info = {**info, "is_success": bool(info[TRUTH_SUCCESS][0])}
        return observation, float(reward), terminated, truncated, info

    def observation(self, observation: Observation) -> Observation:
        """Return an observation under the short keys, its tactile images made smaller."""
        size = TACTILE_SIZE[::-1]
        return {
            _short(key): cv2.resize(value, size, interpolation=cv2.INTER_AREA)
            if key in TACTILE
            else value
            for key, value in observation.items()
        }


def _short(key: str) -> str:
    return key.removeprefix(IMAGE_PREFIX).removeprefix(_OBSERVATION).replace(".", "_")

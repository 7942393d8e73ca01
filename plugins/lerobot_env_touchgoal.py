"""touchgoal's environments in lerobot: `--env.type=touchgoal --env.task=pick-place`."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import lerobot_policy_touchgoal  # noqa: F401  registers the policy: lerobot imports this module alone
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

import touchgoal
from touchgoal.control.features import CONTROL_HZ, IMAGE_PREFIX, TRUTH_SUCCESS
from touchgoal.policies.checkpoint import SavedPolicy, find_policy
from touchgoal.sim_envs.config import TASKS, TaskConfig, TaskName

_OBSERVATION, _STATE = "observation.", "observation.state"


class LeRobotEnv(gym.Wrapper[dict[str, Any], np.ndarray, dict[str, Any], np.ndarray]):
    """An environment with the keys that lerobot expects before it renames them.

    "observation.images.front" is ["pixels"]["front"], "observation.state" is ["agent_pos"], other keys
    lose their prefix. lerobot's `preprocess_observation` gives all of them their names back.
    """

    def __init__(self, task: TaskName, for_policy: str, render_mode: str | None = None) -> None:
        config = task_config(task, for_policy)
        super().__init__(touchgoal.make(task, config=config, render_mode=render_mode))
        self.task = task
        self._max_episode_steps = round(config.max_seconds * config.control_hz)
        assert isinstance(self.env.observation_space, gym.spaces.Dict)
        renamed = renamed_keys(self.env.observation_space.spaces)
        if "pixels" in renamed:
            renamed["pixels"] = gym.spaces.Dict(renamed["pixels"])
        self.observation_space = gym.spaces.Dict(renamed)

    @property
    def task_description(self) -> str:
        """Instruction of the episode."""
        return self.env.unwrapped.instruction()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; lerobot's own options are not the environment's."""
        own = {k: v for k, v in (options or {}).items() if not k.startswith("lerobot_")}
        observation, info = self.env.reset(seed=seed, options=own)
        return renamed_keys(observation), {"is_success": False, **info}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Run one control tick; see the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        info = {**info, "is_success": bool(info[TRUTH_SUCCESS][0])}
        return renamed_keys(observation), float(reward), terminated, truncated, info


def renamed_keys(values: dict[str, Any]) -> dict[str, Any]:
    """Return values, or spaces, under the keys of `LeRobotEnv`."""
    pixels = {k.removeprefix(IMAGE_PREFIX): v for k, v in values.items() if _is_image(k)}
    others = {k.removeprefix(_OBSERVATION): v for k, v in values.items() if not _is_image(k)}
    return {"agent_pos": others.pop("state"), **others, **({"pixels": pixels} if pixels else {})}


def _is_image(key: str) -> bool:
    return key.startswith(IMAGE_PREFIX)


def task_config(task: TaskName, for_policy: str) -> TaskConfig:
    """Return a task's options, with the images that a policy of touchgoal reads if one is named."""
    config = TASKS[task]()
    return SavedPolicy(find_policy(for_policy)).env_config(config) if for_policy else config


@EnvConfig.register_subclass("touchgoal")
@dataclass
class TouchgoalEnv(EnvConfig):
    """Options of an environment; further ones are `LeRobotEnv`'s."""

    task: str = "pick-place"
    """pick-place or bead-maze."""
    fps: int = CONTROL_HZ
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)
    for_policy: str = ""
    """Policy of touchgoal (a name or folder) whose images alone are rendered; default: all."""

    def __post_init__(self) -> None:
        env = LeRobotEnv(self.task, self.for_policy)
        spaces = env.env.observation_space.spaces
        env.close()
        self.features = {
            key: PolicyFeature(FeatureType.VISUAL if _is_image(key) else _kind(key), space.shape)
            for key, space in spaces.items()
        }
        self.features["action"] = PolicyFeature(FeatureType.ACTION, env.action_space.shape)
        self.features_map = {key: key for key in self.features}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `LeRobotEnv`."""
        return {"for_policy": self.for_policy, "render_mode": "rgb_array"}


def _kind(key: str) -> FeatureType:
    return FeatureType.STATE if key == _STATE else FeatureType.ENV


for _task in TASKS:  # `EnvConfig.gym_id` of each
    gym.register(f"gym_touchgoal/{_task}", LeRobotEnv, kwargs={"task": _task})

"""touchgoal's environments in lerobot: `--env.type=touchgoal --env.task=pick-place`."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import lerobot_camera_touchgoal  # noqa: F401  registers cameras: lerobot imports this module alone
import lerobot_policy_touch  # noqa: F401
import lerobot_policy_touchgoal  # noqa: F401
import lerobot_reward_touchgoal  # noqa: F401
import lerobot_robot_touchgoal  # noqa: F401
import lerobot_teleoperator_touchgoal  # noqa: F401
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

import touchgoal
from touchgoal.control.features import CAMERAS, CONTROL_HZ, IMAGE_PREFIX, TACTILE, TRUTH_SUCCESS
from touchgoal.policies.checkpoint import load_policy
from touchgoal.sim_envs.config import TASKS, TaskName

IMAGES = *CAMERAS, *TACTILE
Values = dict[str, Any]


class LeRobotEnv(gym.Wrapper[Values, np.ndarray, Values, np.ndarray]):
    """An environment with the keys that lerobot expects before it renames them.

    "observation.images.front" is ["pixels"]["front"], "observation.state" is ["agent_pos"], other keys
    lose their prefix. lerobot's `preprocess_observation` gives all of them their names back.
    """

    def __init__(self, task: TaskName, for_policy: str, render_mode: str | None = None) -> None:
        config = TASKS[task]()
        if for_policy:
            config = load_policy(for_policy).env_config(config)
        super().__init__(touchgoal.make(task, config=config, render_mode=render_mode))
        self.task = task
        self._max_episode_steps = round(config.max_seconds * config.control_hz)
        renamed = renamed_keys(self.env.observation_space.spaces)
        if "pixels" in renamed:
            renamed["pixels"] = gym.spaces.Dict(renamed["pixels"])
        self.observation_space = gym.spaces.Dict(renamed)

    task_description = property(lambda self: self.env.unwrapped.instruction())

    def reset(
        self, *, seed: int | None = None, options: Values | None = None
    ) -> tuple[Values, Values]:
        """Start an episode; lerobot's own options are not the environment's."""
        own = {k: v for k, v in (options or {}).items() if not k.startswith("lerobot_")}
        observation, info = self.env.reset(seed=seed, options=own)
        return renamed_keys(observation), {"is_success": False, **info}

    def step(self, action: np.ndarray) -> tuple[Values, float, bool, bool, Values]:
        """Run one control tick; see the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        info = {**info, "is_success": bool(info[TRUTH_SUCCESS][0])}
        return renamed_keys(observation), float(reward), terminated, truncated, info


def renamed_keys(values: Values) -> Values:
    """Return values, or spaces, under the keys of `LeRobotEnv`."""
    pixels = {k.removeprefix(IMAGE_PREFIX): v for k, v in values.items() if k in IMAGES}
    others = {k.removeprefix("observation."): v for k, v in values.items() if k not in IMAGES}
    return {"agent_pos": others.pop("state"), **others, **({"pixels": pixels} if pixels else {})}


@EnvConfig.register_subclass("touchgoal")
@dataclass
class TouchgoalEnv(EnvConfig):
    """Options of an environment; further ones are `LeRobotEnv`'s."""

    task: str = "pick-place"
    """pick-place or bead-maze."""
    fps: int = CONTROL_HZ
    for_policy: str = ""
    """Policy of touchgoal (a name or folder) whose images alone are rendered; default: all."""

    def __post_init__(self) -> None:
        env = LeRobotEnv(self.task, self.for_policy)
        env.close()
        self.features = {
            key: PolicyFeature(FeatureType.VISUAL if key in IMAGES else FeatureType.STATE, s.shape)
            for key, s in env.env.observation_space.spaces.items()
        }
        self.features["action"] = PolicyFeature(FeatureType.ACTION, env.action_space.shape)
        self.features_map = {key: key for key in self.features}

    @property
    def gym_kwargs(self) -> Values:
        """Arguments of `LeRobotEnv`."""
        return {"for_policy": self.for_policy, "render_mode": "rgb_array"}


for _task in TASKS:  # `EnvConfig.gym_id` of each
    gym.register(f"gym_touchgoal/{_task}", LeRobotEnv, kwargs={"task": _task})

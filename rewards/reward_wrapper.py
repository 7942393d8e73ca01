"""The cost to a goal as the reward of a Gymnasium environment, and the judge of its episodes."""

from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from touchgoal.control.features import CONTROL_HZ, Observation
from touchgoal.rewards.goals import Inputs
from touchgoal.rewards.online import CostMeter
from touchgoal.rewards.reward import Reward


def inputs_of(env: gym.Env) -> Inputs:
    """Return what is known about an environment's observations, for `Reward.prepare`.

    Its `sensor`, with a name, and `task` count if it has them, as touchgoal's environments do.
    """
    space = env.observation_space
    keys = set(space) if isinstance(space, gym.spaces.Dict) else set()
    sensor, task = (getattr(env.unwrapped, name, None) for name in ("sensor", "task"))
    scene, task = f"simulated {task}" if task else "unknown", str(task or "")
    sensor = getattr(sensor, "name", None)
    return Inputs.of("the environment", keys, sensor=sensor, scene=scene, task=task)


class RewardWrapper(gym.Wrapper[Observation, np.ndarray, Observation, np.ndarray]):
    """Replaces an environment's reward by one from the cost to a goal outside the episode.

    A step pays the fall of the cost: holding still pays nothing, and the return depends only on the
    first and the last cost. `info` has the `cost` and the environment's own reward as `task_reward`.
    """

    def __init__(self, env: gym.Env, reward: Reward) -> None:
        """Wrap an environment whose observations have touchgoal's keys.

        UserError: a goal inside the episode, or one that the observations cannot be compared with.
        """
        super().__init__(env)
        rate = getattr(getattr(env.unwrapped, "config", None), "control_hz", CONTROL_HZ)
        self._rate = float(rate)
        self._reward = reward.prepare(inputs_of(env))
        self._meter = CostMeter(self._reward, rate=self._rate)
        self._cost = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode, whose first observations must be free of contact."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._meter = CostMeter(self._reward, str(info.get("object", "")), self._rate)
        self._cost = self._measure(observation)
        return observation, {**info, "cost": self._cost}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Run one step; see the class for the reward."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        before, self._cost = self._cost, self._measure(observation)
        info = {**info, "cost": self._cost, "task_reward": reward}
        return observation, before - self._cost, terminated, truncated, info

    def _measure(self, observation: Observation) -> float:
        self._meter.add(observation)
        reading = self._meter.measure()
        assert reading is not None  # of the observation just added
        return reading.cost


class RunJudge:
    """Judge of one episode of an environment, as `deploy` asks it: once a second, and at the end."""

    def __init__(self, judge: str | Path, env: gym.Env) -> None:
        """Take a judge, see `Reward.of_judge`, and an environment of touchgoal after its reset.

        UserError: no judge lies there, or it cannot judge such observations.
        """
        reward = _judged_reward(judge).prepare(inputs_of(env))
        about, self._rate = env.unwrapped.episode_info(), env.unwrapped.config.control_hz  # pyright: ignore[reportAttributeAccessIssue]
        self._meter = CostMeter(reward, str(about.get("object", "")), self._rate, judges=True)

    def ended(self, tick: Observation) -> bool:
        """Take the next tick; return whether the judge says lastingly that the task is done."""
        self._meter.add(tick)
        reading = self._meter.measure() if len(self._meter.waiting) >= self._rate else None
        return reading is not None and reading.done

    def verdict(self) -> str:
        """Return the verdict on the newest tick as the episode's end."""
        self._meter.measure()
        return self._meter.judge().verdict


_judged_reward = cache(Reward.of_judge)  # encoders are loaded once a process

"""Environments by name as users make them: of the simulator, for RL, or several at once."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import gymnasium as gym

from touchgoal.runtime.errors import UserError, unknown_name
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.for_rl import ForRL
from touchgoal.sim_envs.tasks import ENVIRONMENTS

if TYPE_CHECKING:
    from touchgoal.rewards.reward import Reward
    from touchgoal.rewards.reward_wrapper import RewardWrapper

Touch = Literal["image", "embedding"]
_No = Literal[False]
_BY_NAME = {env.task: env for env in ENVIRONMENTS.values()}


@overload
def make(
    task: str, *, reward: "Reward", for_rl: _No = False, **options: Any
) -> "RewardWrapper": ...
@overload
def make(
    task: str, *, reward: None = None, for_rl: _No = False, **options: Any
) -> FrankaTactileEnv: ...
@overload
def make(task: str, *, for_rl: Literal[True], **options: Any) -> ForRL: ...
def make(
    task: str,
    *,
    for_rl: bool = False,
    reward: "Reward | None" = None,
    touch: Touch = "image",
    encoder: str | Path | None = None,
    **options: Any,
) -> gym.Env:
    """Make the Gymnasium environment of a task.

        env = touchgoal.make("pick-place", reward=touchgoal.Reward(goal="bank:data/episodes"))
        env = touchgoal.make("pick-place", for_rl=True, touch="embedding", cameras=())
        stable_baselines3.PPO("MultiInputPolicy", env).learn(100_000)

    Args:
        task: "pick-place", "bead-maze" or "fragile-carry".
        for_rl: keys without dots and actions in [-1, 1]; see `sim_envs.for_rl.ForRL`.
        reward: the environment's reward is the fall of the cost to its goal, which must lie outside
            the episode ("bank:SET", "episode:SET#K"); see `rewards.reward_wrapper.RewardWrapper`.
            Default: the gain in the task's progress.
        touch: tactile images at a quarter of their size, or embeddings. This option and the next one
            need `for_rl`.
        encoder: touch encoder of embeddings; default: the one that ships for the sensor.
        options: fields of the task's config by name, such as `cameras=("front",)`,
            `camera_size=(96, 96)` or `tactile=False`: see `sim_envs/config.py`. For a field that is
            itself a config, a dict of its changed fields:
            `randomization={"gain": 0.0}`. `render_mode="rgb_array"` is for video recorders.

    Raises:
        UserError: there is no such task or option, a value is out of its range, or the goal of the
            reward cannot be measured here.
    """
    if task not in _BY_NAME:
        raise unknown_name("task", task, _BY_NAME)
    env: gym.Env = _BY_NAME[task](**options)
    if reward is not None:
        from touchgoal.rewards.reward_wrapper import RewardWrapper

        env = RewardWrapper(env, reward)
    if not for_rl:
        if (touch, encoder) != ("image", None):
            raise UserError("touch and encoder need for_rl=True")
        return env
    if touch == "embedding":
        from touchgoal.encoders.embedded_observation import EmbeddedTouch
        from touchgoal.encoders.pretrained import load_encoder, shipped_encoder_for

        sensor = env.get_wrapper_attr("sensor").name
        env = EmbeddedTouch(env, load_encoder(encoder or shipped_encoder_for(sensor), sensor))
    return ForRL(env)


def make_vec(task: str, num_envs: int, **options: Any) -> gym.vector.AsyncVectorEnv:
    """Make several environments for RL, each in a process of its own; see `make` for the options.

    The processes come from a fork server: a process that has rendered must not be forked. A script
    that calls this needs `if __name__ == "__main__":`.
    """
    one = partial(_make_in_worker, task, options)
    return gym.vector.AsyncVectorEnv([one] * num_envs, context="forkserver")


def _make_in_worker(task: str, options: dict[str, Any]) -> ForRL:
    import torch

    torch.set_num_threads(1)  # the workers are themselves many
    return make(task, for_rl=True, **options)

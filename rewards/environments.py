"""Environments by name as users make them: of the simulator, for RL, or several at once."""

from functools import partial
from pathlib import Path
from typing import Any, Literal, overload

import gymnasium as gym

from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.for_rl import ForRL
from touchgoal.sim_envs.fragile_carry import FragileCarry
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.tasks import ENVIRONMENTS

Touch = Literal["picture", "embedding"]
Reward = Literal["progress", "touch"]
_BY_NAME = {env.task: env for env in ENVIRONMENTS.values()}


@overload
def make(
    task: Literal["pick-place"],
    *,
    for_rl: Literal[False] = False,
    **options: Any,
) -> PickPlace: ...
@overload
def make(
    task: Literal["bead-maze"],
    *,
    for_rl: Literal[False] = False,
    **options: Any,
) -> BeadMaze: ...
@overload
def make(
    task: Literal["fragile-carry"],
    *,
    for_rl: Literal[False] = False,
    **options: Any,
) -> FragileCarry: ...
@overload
def make(
    task: str,
    *,
    for_rl: Literal[True],
    touch: Touch = "picture",
    reward: Reward = "progress",
    goal: str | None = None,
    normalizer: str | Path | None = None,
    encoder: str | Path | None = None,
    **options: Any,
) -> ForRL: ...
def make(
    task: str,
    *,
    for_rl: bool = False,
    touch: Touch = "picture",
    reward: Reward = "progress",
    goal: str | None = None,
    normalizer: str | Path | None = None,
    encoder: str | Path | None = None,
    **options: Any,
) -> gym.Env:
    """Make the Gymnasium environment of a task.

        env = touchgoal.make("pick-place", for_rl=True, touch="embedding", cameras=())
        stable_baselines3.PPO("MultiInputPolicy", env).learn(100_000)

    Args:
        task: "pick-place", "bead-maze" or "fragile-carry".
        for_rl: keys without dots and actions in [-1, 1]; see `sim_envs.for_rl.ForRL`.
        touch: tactile images at a quarter of their size, or embeddings. This option and the next
            four need `for_rl`.
        reward: gain in the task's progress, or the fall of the cost to a goal.
        goal: goal of reward "touch", outside the episode: "goal:FILE", "bank:SET", "episode:SET#K".
        normalizer: normalizer.json of reward "touch"; default: the touch encoder's own.
        encoder: touch encoder of embeddings and of reward "touch"; default: the one that ships for the
            sensor.
        options: fields of the task's config by name, such as `cameras=("front",)`,
            `camera_size=(96, 96)` or `tactile=False`: see `sim_envs/config.py`. For a field that is
            itself a config, a dict of its changed fields:
            `randomization={"gain": 0.0}`. `render_mode="rgb_array"` is for video recorders.

    Raises:
        UserError: there is no such task or option, a value is out of its range, or a goal is
            missing.
    """
    if task not in _BY_NAME:
        raise UserError(f"unknown task {task!r}; choose from: {', '.join(_BY_NAME)}")
    env: gym.Env = _BY_NAME[task](**options)
    if not for_rl:
        if (touch, reward, goal, normalizer, encoder) != ("picture", "progress", None, None, None):
            raise UserError("touch, reward, goal, normalizer and encoder need for_rl=True")
        return env
    if (reward == "touch") != (goal is not None):
        raise UserError('reward="touch" needs a goal outside the episode, and only it takes one')
    if reward == "touch":
        env = _with_touch_reward(env, str(goal), normalizer, encoder)
    if touch == "embedding":
        env = _with_embeddings(env, encoder)
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


def _with_touch_reward(
    env: gym.Env, goal: str, normalizer: str | Path | None, encoder: str | Path | None
) -> gym.Env:
    from touchgoal.rewards.goals import parse_goal
    from touchgoal.rewards.online.reward_wrapper import TouchReward, inputs_of
    from touchgoal.rewards.reward_model import load_reward_model

    model = load_reward_model(inputs_of(env), [parse_goal(goal)], encoder, normalizer=normalizer)
    return TouchReward(env, model)


def _with_embeddings(env: gym.Env, encoder: str | Path | None) -> gym.Env:
    from touchgoal.encoders.embedded_observation import EmbeddedTouch
    from touchgoal.encoders.pretrained import load_encoder, shipped_encoder_for

    sensor = env.get_wrapper_attr("sensor").name
    return EmbeddedTouch(env, load_encoder(encoder or shipped_encoder_for(sensor), sensor))

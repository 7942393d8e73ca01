"""Environments for reinforcement learning: Stable-Baselines3 trains on them as they are."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from in_process import run_benchmark
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env

import touchgoal
from benchmarks.papers import shaping
from touchgoal.control import features as ft
from touchgoal.encoders.embedded_observation import TOUCH, EmbeddedTouch
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.for_rl import TACTILE_SIZE

SHORT = {"max_seconds": 0.5, "objects": ("glass_ball",)}


def test_keys_actions_and_touch() -> None:
    env = touchgoal.make("pick-place", for_rl=True, cameras=(), **SHORT)
    check_env(env)
    observation, _ = env.reset(seed=0)
    keys = "state command tcp_pose wrench age tactile_left tactile_right"
    assert set(observation) == set(keys.split())
    assert observation["tactile_left"].shape == (*TACTILE_SIZE, 3)
    plain = touchgoal.make("pick-place", cameras=(), **SHORT)
    plain.reset(seed=0)
    speed, stroke = plain.action_space.high[:7], plain.action_space.high[7]
    action = np.append(np.full(7, 0.5), -1.0).astype(np.float32)
    same = np.append(0.5 * speed, 0.0).astype(np.float32)
    env.step(action)
    plain.step(same)
    (observation, *_, info), (expected, *_) = env.step(action), plain.step(same)
    np.testing.assert_allclose(observation["state"], expected[ft.STATE], atol=1e-6)
    assert stroke > 0 and info["is_success"] is False
    with pytest.raises(UserError, match="need for_rl=True"):
        touchgoal.make("pick-place", touch="embedding")  # type: ignore[call-overload]


def test_the_cost_to_a_goal_as_reward() -> None:
    small = {"cameras": ("front",), "camera_size": (64, 64), **SHORT}
    plain = touchgoal.make("pick-place", **small)
    reward = touchgoal.Reward(plain.reset(seed=0)[0][ft.FRONT])
    for env in (
        touchgoal.make("pick-place", reward=reward, **small),
        touchgoal.make("pick-place", for_rl=True, reward=reward, **small),
    ):
        _, info = env.reset(seed=0)
        _, paid, *_, after = env.step(np.zeros(8, np.float32))
        assert paid == pytest.approx(info["cost"] - after["cost"]), "gamma is 1"
        assert info["cost"] < after["cost"], "it begins at the goal"


def test_embedded_touch_is_the_encoders_and_rests_while_untouched() -> None:
    env = EmbeddedTouch(
        touchgoal.make("pick-place", cameras=(), **SHORT), load_encoder("gelsight_mini")
    )
    seen = np.full((7, 240, 320, 3), 90, np.uint8)
    for frame in seen[2:4]:
        cv2.circle(frame, (160, 120), 40, (190, 20, 140), -1)
    ticks = [env.observation({ft.TACTILE[0]: frame, ft.TACTILE[1]: seen[0]}) for frame in seen]
    left, right = np.split(np.stack([tick[TOUCH] for tick in ticks]), 2, axis=1)
    np.testing.assert_allclose(left, env._encoder.embed_frames(seen, seen[0]), atol=1e-4)
    assert (right == right[0]).all() and not np.allclose(left[2], left[0], atol=0.01)


@pytest.mark.slow
def test_ppo_and_sac_train_as_they_are() -> None:
    env = touchgoal.make("pick-place", for_rl=True, touch="embedding", cameras=(), **SHORT)
    assert env.reset(seed=0)[0]["touch"].shape == (2 * 464,)
    SAC("MultiInputPolicy", env, learning_starts=16, buffer_size=100).learn(32)
    blind = touchgoal.make("pick-place", for_rl=True, tactile=False, cameras=(), **SHORT)
    model = PPO("MultiInputPolicy", blind, n_steps=256, n_epochs=1).learn(1000)
    assert model.num_timesteps >= 1000


def test_several_at_once_with_touch() -> None:
    envs = touchgoal.make_vec("pick-place", 2, cameras=(), **SHORT)
    try:
        observation, _ = envs.reset(seed=[3, 4])
        assert observation["tactile_left"].shape == (2, *TACTILE_SIZE, 3)
        assert not np.array_equal(*observation["state"])
        envs.step(envs.action_space.sample())
    finally:
        envs.close()


@pytest.mark.slow
def test_benchmark_shaping(tmp_path: Path) -> None:
    """The scripted success is paid by both rewards; trainings on file are not made anew."""
    sizes = "--decisions 20 --every 10 --trials 1 --goals 2 --seeds 1"
    run_benchmark("shaping", *sizes.split(), "--out", tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert [len(curve) for curves in metrics["curves"].values() for curve in curves] == [2, 2]
    given = shaping.Config(), tmp_path
    sparse, shaped = (shaping.training_env(*given, arm) for arm in ("sparse", "shaped"))
    for env, least, most in ((sparse, 1.0, 1.0), (shaped, 1.3, 2.2)):
        env.reset(seed=0)
        first = getattr(env, "_cost", 0.0)
        paid, ended, script = [], False, iter(shaping.SCRIPT)
        while not ended:
            _, reward, ended, *_ = env.step(np.array(next(script)))
            paid.append(reward)
        assert least <= sum(paid) <= most
        if env is shaped:  # discounted, potentials telescope: only the first and the last count
            gained = sum(0.95**t * r for t, r in enumerate(paid)) - 0.95 ** (len(paid) - 1)
            assert gained == pytest.approx(0.95 ** len(paid) * (1 - env._cost) - (1 - first))
        assert (max(paid[:-1]) > 0.1) == (env is shaped), "the touch is paid at once"

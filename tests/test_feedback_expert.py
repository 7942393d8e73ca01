"""Pick and place as a law of the present state, and learners that it corrects."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_policies import TOY, toy_dataset, toy_policy

from touchgoal.control import features as ft
from touchgoal.episodes.recording import CORRECTED, EpisodeSpec, record_episode
from touchgoal.policies import checkpoint
from touchgoal.policies.checkpoint import SavedPolicy
from touchgoal.policies.perception.state_estimation import ESTIMATED
from touchgoal.policies.training.dagger import DaggerRoles
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place_feedback import FeedbackExpert
from touchgoal.sim_envs.pick_place import PickPlace

BLIND = PickPlaceConfig(cameras=(), tactile=False)
JOB = EpisodeSpec(1, options={"object": "wooden_block"})


@pytest.mark.parametrize("disturbance", [0.0, 0.01])
def test_it_picks_and_places_though_it_is_led_astray(disturbance: float) -> None:
    episode = record_episode(PickPlace(replace(BLIND, disturbance=disturbance)), JOB, DaggerRoles())
    assert episode.meta["success"]
    moved = np.abs(episode.frames[ft.ACTION][:, :7])
    assert moved.max() < 0.1  # rad a tick, 2 rad/s: an FR3 may turn its slowest joint as fast


def test_it_comes_back_from_where_it_never_went() -> None:
    env = PickPlace(BLIND)
    observation, _ = env.reset(seed=JOB.seed, options=JOB.options)
    expert, success = FeedbackExpert(env), False
    for tick in range(160):
        action = expert.act(observation)
        if 8 <= tick < 18:  # somebody else has the arm
            action = np.append(0.02 * np.array([1, -1, 0, 1, 0, 0, 0]), action[-1])
        observation, _, success, _, _ = env.step(action)
        if success:
            break
    assert success


def test_it_gives_way_to_what_it_presses_on() -> None:
    env = PickPlace(BLIND)
    observation, _ = env.reset(seed=JOB.seed, options=JOB.options)
    expert, forces = FeedbackExpert(env), []
    for tick in range(160):
        action = expert.act(observation)
        if tick < 50:  # somebody else presses the closed hand on the table
            down = env.kinematics.joint_change(env.command, np.array([0, 0, -0.008, 0, 0, 0]))
            action = np.append(down if env.external_wrench()[2] < 40 else np.zeros(7), 0.0)
        elif tick < 60:
            assert env.kinematics.jacobian(env.command)[2] @ action[:7] > 0 or forces[-1] < 4
        observation, *_ = env.step(action)
        forces.append(env.external_wrench()[2])
    assert max(forces) > 30 and forces[-1] < 10


def test_it_rights_a_tilted_hand_bit_by_bit() -> None:
    """Whoever copies it two ticks late must not swing: x(t+1) = x(t) - k x(t-2) grows above k = 0.62."""
    env = PickPlace(BLIND)
    env.reset(seed=JOB.seed, options=JOB.options)

    def tilt() -> float:
        return float(np.arccos(-env.kinematics.forward(env.command)[1][2, 2]))

    tilted = env.kinematics.joint_change(env.command, np.array([0, 0, 0, 0.1, 0.1, 0]))
    env.step(np.append(tilted, 0.08))
    expert, left = FeedbackExpert(env), [tilt()]
    for _ in range(20):
        env.step(expert.act({}))
        left.append(tilt())
    assert left[0] > 0.1 and left[-1] < 0.02 * left[0]
    shares = 1 - np.array(left[1:6]) / left[:5]
    assert (shares > 0.15).all() and (shares < 0.31).all()


def test_a_learner_acts_and_is_corrected(tmp_path: Path) -> None:
    config = replace(
        TOY,
        touch_dim=0,
        touch="",
        proprioception=(ft.STATE, ft.TCP_POSE, *ESTIMATED),
        position_noise=0.0,
    )
    checkpoint.save(toy_policy(config, toy_dataset(config)), tmp_path / "learner", {})
    roles, env = (
        DaggerRoles(SavedPolicy(tmp_path / "learner")),
        PickPlace(replace(BLIND, max_seconds=1.0)),
    )
    episode = record_episode(env, JOB, roles)
    assert episode.meta["outcome"] == CORRECTED
    observation, _ = env.reset(seed=JOB.seed, options=JOB.options)
    learner, expert = roles(env, JOB)
    for tick in range(20):
        answer, action = expert.act(observation), learner.act(observation)
        np.testing.assert_array_equal(episode.frames[ft.STATE][tick], observation[ft.STATE])
        np.testing.assert_allclose(episode.frames[ft.ACTION][tick], answer, atol=1e-6)
        assert not np.allclose(action, answer)
        observation, *_ = env.step(action)

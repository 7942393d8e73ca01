"""Estimators and the feedback expert: what a policy learns on, and what corrects it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_policies import TOY, torch_rng, toy_dataset, toy_policy

from touchgoal.control import features as ft
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.recording import CORRECTED, EpisodeSpec, record_episode
from touchgoal.policies import checkpoint
from touchgoal.policies.checkpoint import SavedPolicy
from touchgoal.policies.config import PoseEstimatorConfig, PoseTrainConfig
from touchgoal.policies.perception.placements import Placements
from touchgoal.policies.perception.pose_estimator import PoseEstimator
from touchgoal.policies.perception.pose_training import pose_errors, train_pose_estimator
from touchgoal.policies.perception.proprioception import network_input
from touchgoal.policies.perception.state_estimation import ESTIMATED, StateEstimator
from touchgoal.policies.training.dagger import DaggerRoles
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place_feedback import FeedbackExpert
from touchgoal.sim_envs.pick_place import WORKSPACE, PickPlace

CROPS = ((ft.FRONT, (0, 16, 0, 16)),)
SMALL = PoseEstimatorConfig((16, 16), CROPS, channels=8, keypoints=4, keypoint_features=4, width=16)


def toy_estimator() -> StateEstimator:
    torch.manual_seed(0)
    return StateEstimator(PoseEstimator(SMALL).eval())


def test_the_start_is_seen_from_the_hand() -> None:
    columns = ft.TCP_POSE, ft.TRUTH_CONTACT, ft.TRUTH_START
    yaw, hand = 0.4, 0.3
    pose = [0.5, 0.1, 0.2, 0.0, np.cos(hand / 2), np.sin(hand / 2), 0.0]  # fingers down
    start = [0.45, 0.15, 0.03, np.cos(2 * yaw), np.sin(2 * yaw), 0.6, -0.1]
    left = 2 * (yaw - hand)
    for contact in ([0.0, 1.0], [1.0, 1.0]):  # the object matters, or the goal
        held = contact == [1.0, 1.0]
        row = torch.tensor([pose + contact + start])
        observed = network_input(row, columns, "base_twist")[0, 11:].numpy()
        way = np.array([0.0, 0.0, -0.17, 0.1, -0.2] if held else [-0.05, 0.05, -0.17, 0.0, 0.0])
        twice = [0.0, 0.0] if held else [np.cos(left), np.sin(left)]
        expected = [*way, *twice, *way / (np.abs(way) + 0.02)]
        np.testing.assert_allclose(observed, expected, atol=1e-6)


def train_pose(count: int, epochs: int, out: Path) -> float:
    """Train the pose estimator on bright spots on grey; return the median error, mm."""
    spots = torch.randint(0, 14, (count, 2), generator=torch_rng())
    pictures = torch.full((count, 16, 16, 3), 128, dtype=torch.uint8)
    for picture, (row, column) in zip(pictures, spots, strict=True):
        picture[row : row + 2, column : column + 2] = 255
    start = torch.zeros(count, 7)
    start[:, 3] = 1.0
    start[:, :2] = spots / 100
    tcp = torch.randn(count, 7, generator=torch_rng())
    placements = Placements({ft.FRONT: pictures}, tcp, start)
    sight = PoseEstimator(SMALL)
    config = PoseTrainConfig(epochs=epochs, lr=1e-2)
    train_pose_estimator(sight, placements, config, out, TrainerOptions(), {})
    return pose_errors(sight, placements)["object_mm"][0]


def test_contact_is_the_simulators_in_every_tick() -> None:
    env = PickPlace(PickPlaceConfig(camera_size=(16, 16), cameras=("front",)))
    episode = record_episode(env, EpisodeSpec(4, options={"object": "wooden_block"}))
    frames, estimator = episode.frames, toy_estimator()
    ticks = [{k: v[i] for k, v in frames.items()} for i in range(len(frames[ft.ACTION]))]
    found = np.stack([estimator.estimate(tick, ticks[0])[ft.TRUTH_CONTACT] for tick in ticks])
    assert frames[ft.TRUTH_CONTACT].any(0).all() and not frames[ft.TRUTH_CONTACT][0].any()
    np.testing.assert_array_equal(found, frames[ft.TRUTH_CONTACT])
    estimator.estimate(ticks[40], ticks[0])
    again = ticks[0] | {}  # another episode begins
    assert not estimator.estimate(again, again)[ft.TRUTH_CONTACT].any()


def test_a_place_is_learnt(tmp_path: Path) -> None:
    torch.manual_seed(0)
    assert train_pose(256, 75, tmp_path) < 15  # 60 by chance


SEES = (ft.STATE, ft.TCP_POSE, *ESTIMATED)
ESTIMATING = replace(TOY, touch_dim=0, touch="", proprioception=SEES, position_noise=0.0)


def test_a_rearrangement_is_a_beginning() -> None:
    env = PickPlace(PickPlaceConfig(cameras=(), tactile=False))
    _, first = env.reset(seed=3, options={"object": "wooden_block"})
    observation, info = env.rearrange()
    start, (low, high) = info[ft.TRUTH_START], np.array(WORKSPACE).T
    assert not np.allclose(start, first[ft.TRUTH_START])
    np.testing.assert_allclose(start[:3], info[ft.TRUTH_OBJECT_POSE][:3], atol=1e-6)
    for place in (start[:2], start[5:]):
        assert (low - 0.01 < place).all() and (place < high + 0.01).all()
    twice = 2 * env.grasp_yaw()
    np.testing.assert_allclose(start[3:5], [np.cos(twice), np.sin(twice)], atol=1e-6)
    assert np.linalg.norm(observation[ft.TCP_POSE][:3] - [0.45, 0, 0.26]) < 0.06


BLIND = PickPlaceConfig(cameras=(), tactile=False)
JOB = EpisodeSpec(1, options={"object": "wooden_block"})


@pytest.mark.parametrize("disturbance", [0.0, 0.01])
def test_it_picks_and_places_though_it_is_led_astray(disturbance: float) -> None:
    episode = record_episode(PickPlace(replace(BLIND, disturbance=disturbance)), JOB, DaggerRoles())
    assert episode.meta["success"]
    moved = np.abs(episode.frames[ft.ACTION][:, :7])
    assert moved.max() < 0.1  # rad a tick, 2 rad/s: an FR3 may turn its slowest joint as fast


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


def test_a_learner_acts_and_is_corrected(tmp_path: Path) -> None:
    learner = toy_policy(ESTIMATING, toy_dataset(ESTIMATING))
    checkpoint.save(learner, tmp_path / "learner", {})
    roles = DaggerRoles(SavedPolicy(tmp_path / "learner"))
    env = PickPlace(replace(BLIND, max_seconds=1.0))
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

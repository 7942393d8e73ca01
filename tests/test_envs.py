"""Contract of every environment, and the laws that grasping in the simulator must obey."""

import subprocess
import sys
from dataclasses import replace
from typing import Literal

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import touchgoal
from touchgoal.control import features as ft
from touchgoal.episodes.outcomes.verify import outcome_reached
from touchgoal.episodes.recording import EpisodeSpec, episode_spec, record_episode
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import BeadMazeConfig, FragileCarryConfig, Outcome, PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import OUTCOMES, PickPlaceExpert
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.objects import CATALOGUE, SHAPES
from touchgoal.sim_envs.scene.rendering import open_renderer
from touchgoal.sim_envs.tasks import TaskConfig, make_env

ENVS = ["touchgoal/PickPlace-v0", "touchgoal/BeadMaze-v0", "touchgoal/FragileCarry-v0"]
BLIND = PickPlaceConfig(cameras=(), tactile=False)
STILL = np.zeros(8)


@pytest.fixture
def blind():
    env = PickPlace(BLIND)
    yield env
    env.close()


def rollout(env, expert):
    while True:
        observation, _, terminated, truncated, info = env.step(expert.act({}))
        if terminated or truncated:
            return observation, terminated, info


def lift(env, **options):
    """Grasp and lift, then hold still for a second."""
    env.reset(seed=3, options=options)
    expert = PickPlaceExpert(env)
    for _ in range(66):
        env.step(expert.act({}))
    for _ in range(20):
        env.step(STILL)


@pytest.mark.parametrize("name", ENVS)
def test_gymnasium_contract(name: str) -> None:
    env = gym.make(name)
    check_env(env.unwrapped, skip_render_check=True)
    observation, info = env.reset(seed=0)
    for key, value in (observation | info).items():
        assert value.shape == ft.FEATURES[key].shape and value.dtype == ft.FEATURES[key].dtype
    truth = {key for key in ft.FEATURES if key.startswith("truth.")}
    of_some_tasks = {ft.TRUTH_FAILURE, ft.TRUTH_START}
    assert truth - of_some_tasks <= info.keys() <= truth
    env.close()


@pytest.mark.parametrize("name", ENVS)
def test_same_seed_same_episode(name: str) -> None:
    runs = []
    for seed in (5, 5, 6):
        env = gym.make(name)
        env.reset(seed=seed)
        env.action_space.seed(0)
        runs.append([env.step(env.action_space.sample())[0] for _ in range(5)][-1])
        env.close()
    for key in runs[0]:
        np.testing.assert_array_equal(runs[0][key], runs[1][key])
    assert not np.array_equal(runs[0][ft.TACTILE_LEFT], runs[2][ft.TACTILE_LEFT])


def test_environments_are_registered_once_gymnasium_is_imported() -> None:
    alone = "import sys, touchgoal; assert not {'gymnasium', 'mujoco', 'torch'} & set(sys.modules)"
    registered = f"assert {set(ENVS)} <= set(gymnasium.registry)"
    for imports in (f"{alone}; import gymnasium", "import gymnasium, touchgoal"):
        subprocess.run([sys.executable, "-c", f"{imports}; {registered}"], check=True)
    named = f"import gymnasium; gymnasium.make('touchgoal:{ENVS[0]}')"
    subprocess.run([sys.executable, "-c", named], check=True)
    for name in ENVS:
        ticks, env = gym.spec(name).max_episode_steps, gym.make(name).unwrapped
        assert isinstance(env, FrankaTactileEnv)
        assert ticks == env.config.max_seconds * env.config.control_hz


def test_options_by_name() -> None:
    env = gym.make("touchgoal/PickPlace-v0", camera_size=(96, 90), cameras=("front",))
    assert env.observation_space[ft.FRONT].shape == (96, 90, 3)  # type: ignore[index]
    maze = touchgoal.make("bead-maze", tactile=False, randomization={"gain": 0.0})
    assert isinstance(maze, BeadMaze) and not maze.config.tactile
    assert maze.config.randomization == replace(BeadMazeConfig().randomization, gain=0.0)
    with pytest.raises(UserError, match="unknown option of .* 'blurr': did you mean blur"):
        touchgoal.make("pick-place", randomization={"blurr": 0.0})


def test_a_forked_worker_refuses_to_render() -> None:
    """In Mesa it would wait for ever if its parent has rendered. Not forked: test_for_rl.py."""
    program = """
import gymnasium as gym, touchgoal
make = lambda: gym.make("touchgoal/PickPlace-v0", cameras=("front",), tactile=False)
make().reset(seed=0)
gym.vector.AsyncVectorEnv([make], context="fork").reset(seed=0)
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    assert ran.returncode != 0 and "UserError: this process was forked" in ran.stderr
    assert 'context="forkserver"' in ran.stderr


@pytest.mark.parametrize("arm", ["fr3", "ur5e"])
@pytest.mark.parametrize(
    "config", [BLIND, BeadMazeConfig(tactile=False), FragileCarryConfig(tactile=False)]
)
def test_expert_is_recorded_on_every_arm(config: TaskConfig, arm: Literal["fr3", "ur5e"]) -> None:
    env = make_env(replace(config, max_seconds=0.6, arm=arm))
    episode = record_episode(env, EpisodeSpec(seed=0))
    episode.check()
    for key in (ft.STATE, ft.ACTION):
        assert episode.frames[key].shape[1:] == ft.features_of(env.n_joints)[key].shape


def test_full_meshes_show_the_arm_of_the_fast_ones_and_leave_physics_alone() -> None:
    silhouettes, states = [], []
    for meshes in ("fast", "full"):
        env = PickPlace(replace(BLIND, meshes=meshes))
        env.reset(seed=3)
        renderer = open_renderer(env.model, 240, 320)
        renderer.enable_segmentation_rendering()
        renderer.update_scene(env.data, "side")
        shown = renderer.render()[..., 0]
        robot = np.append(env.model.body_rootid[env.model.geom_bodyid] == 1, False)
        silhouettes.append(robot[shown])
        states.append(env.step(np.append(np.full(7, 0.01), 0.04))[0][ft.STATE])
        renderer.close()
        env.close()
    fast, full = silhouettes
    assert (fast & full).sum() > 0.95 * (fast | full).sum() > 1000
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize("shape", SHAPES)
def test_expert_places_every_shape(blind: PickPlace, shape: str) -> None:
    name = next(k.name for k in CATALOGUE.values() if k.shape == shape)
    blind.reset(seed=1, options={"object": name})
    _, success, info = rollout(blind, PickPlaceExpert(blind))
    assert success and info[ft.TRUTH_PROGRESS] == 1
    distance = np.linalg.norm(info[ft.TRUTH_OBJECT_POSE][:2] - blind.goal)
    assert distance < blind.config.tolerance and info[ft.TRUTH_CONTACT].all()


def test_expert_lets_go_when_asked() -> None:
    env = PickPlace(PickPlaceConfig(cameras=(), tactile=False, release=True))
    env.reset(seed=1)
    _, success, info = rollout(env, PickPlaceExpert(env))
    assert success and not info[ft.TRUTH_CONTACT].any()


@pytest.mark.parametrize("outcome", OUTCOMES)
def test_outcomes_to_order(outcome: Outcome) -> None:
    """Truth confirms the outcome that was asked for, and no failure in a plain success."""
    config = PickPlaceConfig(cameras=(), tactile=False, distractors=1, max_seconds=16)
    spec = episode_spec(2, outcome, {"object": "brick"})
    episode = record_episode(PickPlace(config), spec)
    assert episode.meta["outcome"] == outcome
    plain = record_episode(PickPlace(config), EpisodeSpec(2, "success", spec.options))
    alike = ("success", "slow", "same_shape")  # as success, or with success's plan
    assert outcome_reached(outcome, plain.frames) == (outcome in alike)


@pytest.mark.parametrize("name", ["glass_ball", "wooden_block", "pebble", "sausage"])
@pytest.mark.parametrize("force", [5.0, 30.0])
def test_grasp_force_weight_and_creep(blind: PickPlace, name: str, force: float) -> None:
    lift(blind, object=name, grasp_force=force, mass=0.1)

    def in_hand() -> np.ndarray:
        tcp = blind.data.site("tcp")
        return tcp.xmat.reshape(3, 3).T @ (blind.object_pose()[:3] - tcp.xpos)

    before = in_hand()
    for _ in range(20):
        blind.step(STILL)
    pads = blind.pad_contacts()
    assert np.linalg.norm(in_hand() - before) < 0.02e-3  # m in one second
    for pad in pads:
        assert pad.normal_force == pytest.approx(force, rel=0.02)
        assert pad.slip_speed < 1e-3
    np.testing.assert_allclose(blind.external_wrench()[:3], [0, 0, -0.1 * 9.81], atol=0.03)
    weight = sum(pad.force[0] for pad in pads)  # x points down the finger
    assert weight == pytest.approx(0.1 * 9.81, rel=0.02)


def test_a_long_grasp_lets_go_at_once(blind: PickPlace) -> None:
    lift(blind, object="wooden_block", grasp_force=20.0, mass=0.1)
    for _ in range(20):
        blind.step(STILL)
    held = blind.width()
    for _ in range(3):
        blind.step(np.append(STILL[:-1], 0.08))
    # At 0.1 m/s for 0.15 s, the pads let go first.
    assert blind.width() - held > 0.5 * 0.15 * 0.1


def test_weak_grasp_loses_a_heavy_object(blind: PickPlace) -> None:
    """Coulomb: 0.2 kg at friction 0.6 needs 1.64 N on each side."""
    lift(blind, object="glass_ball", grasp_force=1.5, mass=0.2)
    lost = blind.object_pose()[2]
    lift(blind, object="glass_ball", grasp_force=2.5, mass=0.2)
    assert lost < 0.05 < blind.object_pose()[2]

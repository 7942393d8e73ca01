"""An environment as deployed: what is late is late by what it says."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.control.safety.limits import TASK_FORCES
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.cell.deployment import DeploymentConfig
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace

BLIND = PickPlaceConfig(cameras=(), tactile=False)
NO = (0.0, 0.0)
PROMPT = DeploymentConfig(NO, NO, image_rate=1000.0, command_delay=NO, jitter=NO)


def roll(actions, config=BLIND, seed=3, between=None):
    """Observations of these actions, the reset's first; with delays in place of none."""
    if between is not None:
        config = replace(config, as_deployed=True, deployment=replace(PROMPT, **between))
    env = PickPlace(config)
    seen = [env.reset(seed=seed, options={"object": "wooden_block"})[0]]
    seen += [env.step(action)[0] for action in actions]
    env.close()
    return seen


def moving(n=8):
    actions = np.zeros((n, 8))
    actions[:, 0], actions[:, 3], actions[:, 7] = 0.01, -0.008, 0.08
    return actions


def column(seen, key=ft.STATE):
    return np.stack([observation[key] for observation in seen])


def test_delays_that_would_do_nothing_are_refused() -> None:
    with pytest.raises(UserError, match="need as_deployed"):
        replace(BLIND, deployment=PROMPT)


@pytest.mark.parametrize("option", ["state_delay", "image_delay"])
def test_what_is_seen_is_as_old_as_it_says(option: str) -> None:
    """And remains so while the arm rests after the end."""
    config = replace(BLIND, cameras=("front",), camera_size=(32, 32), max_seconds=0.2)
    here = roll(moving(24), config, between={})
    late = roll(moving(24), config, between={option: (0.1, 0.1)})
    for key in (ft.STATE, ft.TCP_POSE, ft.WRENCH, ft.FRONT):
        images = key == ft.FRONT
        ticks = 2 if images == (option == "image_delay") else 0
        now, then = column(here, key), column(late, key)
        assert np.array_equal(then[ticks:], now[: len(now) - ticks]), key
        assert np.array_equal(then[:ticks], now[:1].repeat(ticks, 0)), key
    assert not column(here, ft.AGE).any()
    np.testing.assert_allclose(column(late, ft.AGE)[:, 0], np.arange(25).clip(0, 2) / 20, atol=1e-6)


def test_a_command_arrives_so_late() -> None:
    now = column(roll(moving(), between={}))[:, :7]
    late = column(roll(moving(), between={"command_delay": (0.1, 0.1)}))[:, :7]
    assert np.abs(late[2:] - now[:-2]).max() < 1e-5
    assert np.abs(late[2] - late[0]).max() < 1e-5 < np.abs(now[2] - now[0]).max()


def test_a_seed_repeats_and_keeps_its_scene() -> None:
    config = replace(BLIND, as_deployed=True)
    one, again, other = (roll(moving(), config, seed) for seed in (3, 3, 4))
    for key in (ft.STATE, ft.WRENCH):
        assert np.array_equal(column(one, key), column(again, key))
    assert not np.array_equal(column(one, ft.WRENCH), column(other, ft.WRENCH))
    scenes = []
    for as_deployed in (False, True):
        env = PickPlace(replace(BLIND, as_deployed=as_deployed))
        env.reset(seed=5)
        scenes.append(np.concatenate([env.object_pose(), env.goal, env.command]))
    assert np.array_equal(*scenes)


def test_commands_are_seen_without_delay() -> None:
    late = {"state_delay": (0.1, 0.1), "command_delay": (0.1, 0.1)}
    for between in (None, {}, late):
        command = column(roll(moving(), between=between), ft.COMMAND)
        np.testing.assert_allclose(np.diff(command[:, :7], axis=0), moving()[:, :7], atol=1e-6)
        np.testing.assert_allclose(command[1:, 7:], moving()[:, :7] * 20, atol=1e-4)


def test_the_truth_of_the_pads_is_as_old_as_their_images() -> None:
    def contact(delay: float) -> np.ndarray:
        late = {"as_deployed": True, "deployment": replace(PROMPT, image_delay=(delay, delay))}
        env = BeadMaze(BeadMazeConfig(cameras=(), tactile=False, **late))
        env.reset(seed=3)
        infos = [env.step(np.zeros(8))[-1] for _ in range(12)]
        return np.stack([info[ft.TRUTH_PAD_WRENCH] for info in infos])

    now, late = contact(0.0), contact(0.1)
    assert np.abs(now[-1]).max() > 1 and not np.array_equal(now[2:], now[:-2])
    np.testing.assert_array_equal(late[2:], now[:-2])


@pytest.mark.parametrize("as_deployed", [True, False])
def test_an_episode_ends_at_the_ceiling_of_force(as_deployed: bool) -> None:
    """Closed fingers, down onto a block: the arm stops within 30 ms, not at the tick after next."""
    env = PickPlace(replace(BLIND, as_deployed=as_deployed))
    observation, _ = env.reset(seed=3, options={"object": "wooden_block"})
    step_physics, forces, times = env.step_physics, [], []

    def watched(*arguments: Any) -> None:
        step_physics(*arguments)
        forces.append(float(np.linalg.norm(env._reader.read(env.data)[1][:3])))
        times.append(env.data.time)

    env.step_physics = watched  # type: ignore[method-assign]
    ended, info = False, {}
    while not ended and len(times) < 6000:
        away = 0.2 * (env.object_pose()[:3] - observation[ft.TCP_POSE][:3])[:2]
        down = -0.005 if np.linalg.norm(away) < 0.003 else 0.0
        way = np.append(np.clip(away, -0.01, 0.01), down)
        step = env.kinematics.joint_change(env.command, np.append(way, np.zeros(3)))
        observation, _, ended, _, info = env.step(np.append(step, 0.0))
    assert ended and env.failures() == ["over_force"] and not info[ft.TRUTH_SUCCESS]
    first = next(i for i, f in enumerate(forces) if f > TASK_FORCES["pick-place"].force_ceiling)
    assert times[-1] - times[first] < 0.03

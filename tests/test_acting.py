"""Policies that act, in real time and tick by tick."""

import shutil
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_policies import (
    TOY,
    torch_rng,
    toy_dataset,
    toy_network,
    toy_observations,
    toy_policy,
    toy_touch_embedder,
)

from touchgoal.control import features as ft
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.encoders.pretrained import find_encoder
from touchgoal.policies import checkpoint
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.checkpoint import SHIPPED_POLICIES
from touchgoal.policies.network import ObservationBatch, PolicyNetwork
from touchgoal.policies.perception.frozen_touch import TouchEmbedder, load_touch_of
from touchgoal.runtime.errors import RefusedError, UserError
from touchgoal.sim_envs.config import PickPlaceConfig


@pytest.mark.parametrize("plan_ticks", [0, 1, 3])
def test_an_actor_does_its_plans_in_order_and_on_time(plan_ticks: int) -> None:
    touch = toy_touch_embedder()
    policy, ticks = toy_network(touch_dim=touch.dim, execution_horizon=3), toy_observations(8)
    actor = LearnedPolicy(policy, touch, plan_ticks=plan_ticks)
    actor.reset(seed=5)
    done = [actor.act(dict(tick)) for tick in ticks]  # nobody else keeps them
    rows = np.stack([touch.embed_tick([tick], ticks[0]) for tick in ticks])
    states = np.stack([np.concatenate([tick[ft.STATE], tick[ft.TCP_POSE]]) for tick in ticks])
    generator, expected = torch_rng(5), []
    for asked in range(0, 8, 3):  # ticks on whose observation a plan is made
        asked = max(asked - plan_ticks, 0)
        seen = [max(asked - 1, 0), asked]
        batch = ObservationBatch(
            torch.from_numpy(rows[seen])[None], torch.from_numpy(states[seen])[None]
        )
        plan = policy.plan(batch, generator).actions[0].numpy()
        first = plan_ticks if expected else 0
        expected += list(plan[first : first + 3])
    np.testing.assert_allclose(done, expected[:8], rtol=1e-5)


def test_late_observations_slow_the_arm_and_not_the_gripper() -> None:
    """The way until it reacts stays what it is at an age of 0.1 s."""
    touch = toy_touch_embedder()
    network, tick = toy_network(touch_dim=touch.dim, execution_horizon=3), toy_observations(1)[0]

    def plan(age: float) -> np.ndarray:
        policy = LearnedPolicy(network, touch)
        return policy.plan([tick | {ft.AGE: np.array([age], np.float32)}] * policy.history_ticks)

    usual, late, later = plan(0.1), plan(0.2), plan(0.4)
    np.testing.assert_array_equal(plan(0.0), usual)
    reaction = 4 / network.config.control_hz  # a tick for the plan, three that it acts
    for age, actions in ((0.2, late), (0.4, later)):
        way = actions[:, :-1] * (age + reaction)
        np.testing.assert_allclose(way, usual[:, :-1] * (0.1 + reaction), rtol=1e-5)
        np.testing.assert_array_equal(actions[:, -1], usual[:, -1])


def test_an_actor_refuses_what_it_cannot_do() -> None:
    touch = toy_touch_embedder()
    policy = PolicyNetwork(replace(TOY, touch_dim=touch.dim))
    with pytest.raises(UserError, match="this is none: load the one"):
        LearnedPolicy(policy, None)
    with pytest.raises(UserError, match="encoder toy, this is another"):
        LearnedPolicy(policy, TouchEmbedder(touch.encoder, "another"))
    with pytest.raises(UserError, match="5 ticks late"):
        LearnedPolicy(policy, touch, plan_ticks=5)
    with pytest.raises(UserError, match="acts at 20 Hz, not 10"):
        LearnedPolicy(policy, touch).env_config(PickPlaceConfig(control_hz=10))


def test_a_second_of_touch_unlike_the_training_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    touch = toy_touch_embedder()
    config = replace(TOY, touch_dim=touch.dim, watches_novelty=True, execution_horizon=2)
    windows = toy_dataset(config)
    policy, recorded = toy_policy(config, windows).eval(), windows.recorded
    policy.fit_novelty(recorded.touch.float(), recorded.lengths)
    actor, ticks = LearnedPolicy(policy, touch), toy_observations(20)
    for tick in ticks:  # without a limit every touch is accepted
        actor.act(tick)
    assert policy.novelty
    policy.novelty.limit.fill_(1e-3)
    actor.reset()
    for tick in ticks[:18]:
        actor.act(tick)
    with pytest.raises(RefusedError, match="a second touch has been unlike all of the training"):
        actor.act(ticks[18])
    actor.refuses_novelty = False  # as while an expert corrects it
    actor.act(ticks[19])
    actor.refuses_novelty = True
    for novelty, refused in ((0.99, False), (1.01, True)):
        monkeypatch.setattr(policy, "novelty_of", lambda _, found=novelty: found)
        actor.reset()
        with pytest.raises(RefusedError) if refused else nullcontext():
            [actor.act(tick) for tick in ticks]


def test_the_wrench_is_that_beyond_the_first_ticks() -> None:
    """An arm's estimate has a bias of some newtons."""
    network = toy_network(touch_dim=0, touch="", proprioception=(ft.STATE, ft.WRENCH))
    first, second = toy_observations(2)

    def plan(before: float, now: float) -> np.ndarray:
        wrenches = [np.full(6, force, np.float32) for force in (before, now)]
        ticks = [{**t, ft.WRENCH: w} for t, w in zip((first, second), wrenches, strict=True)]
        return LearnedPolicy(network, None).plan(ticks)

    np.testing.assert_array_equal(plan(0.0, 2.0), plan(5.0, 7.0))
    assert not np.array_equal(plan(0.0, 2.0), plan(5.0, 2.0))


class SlowPolicy(LearnedPolicy):
    """Takes its time; remembers its plans."""

    def __init__(self, execution_horizon: int, pause: float) -> None:
        network = toy_network(touch_dim=0, touch="", execution_horizon=execution_horizon)
        super().__init__(network, None)
        self.pause, self.plans = pause, []

    def plan(self, history):
        time.sleep(self.pause if self.plans else 0.0)
        actions = super().plan(history)
        self.plans.append((int(history[-1][ft.STATE][0]), actions))
        return actions


def test_a_late_plan_is_joined_where_it_should_be_by_now() -> None:
    """Every action is one that a plan meant for this very tick; none waits for a plan."""
    planner = SlowPolicy(execution_horizon=3, pause=0.05)
    actor, done = RealTimeActor(planner), []
    for i, tick in enumerate(toy_observations(40)):
        tick[ft.STATE][0] = i
        done.append(actor.act(tick))
        time.sleep(0.02)
    actor.close()
    for i, action in enumerate(done):
        meant = [p[i - tick] for tick, p in planner.plans if 0 <= i - tick < 8]
        assert any(np.array_equal(action, m) for m in meant) or not action[:7].any()
    assert len(planner.plans) > 4
    assert len(actor.latencies) == len(planner.plans) - 1


def test_one_tick_at_a_time_no_observation_is_planned_from_twice() -> None:
    """A slow planner that is asked a tick early for single ticks must not spin on the same one."""
    planner = SlowPolicy(execution_horizon=1, pause=0.02)
    actor = RealTimeActor(planner, timeout=0.0)
    for tick in toy_observations(2):
        actor.act(tick)
        while len(planner.plans) < actor._tick + 1:
            time.sleep(0.01)
    time.sleep(2 * actor.latencies[-1])  # no tick comes any more
    actor.close()
    assert len(planner.plans) == 2


def test_however_quick_the_machine_a_plan_is_done_from_the_tick_after_its_observation() -> None:
    """Equals the simulation with plans that come a tick late."""
    touch = toy_touch_embedder()
    policy = toy_network(touch_dim=touch.dim, execution_horizon=3)
    threaded = RealTimeActor(LearnedPolicy(policy, touch), timeout=20.0)
    plain = LearnedPolicy(policy, touch, plan_ticks=1)
    for i, tick in enumerate(toy_observations(10)):
        time.sleep(0.03 * (i % 3))
        np.testing.assert_array_equal(threaded.act(tick), plain.act(tick))
    threaded.close()


def test_a_planner_that_fails_later_is_not_waited_for() -> None:
    network = toy_network(touch_dim=0, touch="", execution_horizon=1)
    actor = RealTimeActor(LearnedPolicy(network, None), timeout=3600)
    actor.act(toy_observations(1)[0])
    with pytest.raises(KeyError):
        for _ in range(2):  # a plan from the first is needed in the second
            actor.act({})
    actor.close()


def test_a_policy_feels_with_the_encoder_of_its_training(tmp_path: Path) -> None:
    """The one in its folder, else the one that ships under that name, and no other."""
    name = checkpoint.load(SHIPPED_POLICIES["bead-maze"]).config.touch
    assert load_touch_of(tmp_path / "none", name).name == name
    shutil.copytree(find_encoder("gelsight_mini"), tmp_path / "touch")
    assert load_touch_of(tmp_path / "touch", name).name != name
    with pytest.raises(UserError, match="none like it ships"):
        load_touch_of(tmp_path / "none", "gelsight_mini/v1/0123456789ab")

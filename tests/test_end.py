"""A policy says when the task is done."""

from dataclasses import replace

import numpy as np
import torch
from toy_policies import TOY, toy_dataset, toy_observations, toy_policy

import touchgoal
from touchgoal.control import features as ft
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.evaluation.evaluate import FALSELY_DONE
from touchgoal.policies.network import PolicyNetwork
from touchgoal.policies.training.end import fit_end
from touchgoal.policies.training.sequence_dataset import SequenceDataset
from touchgoal.sim_envs.config import PickPlaceConfig

CONFIG = replace(TOY, touch_dim=0, touch="", says_end=True, execution_horizon=2)
LIFTED = 0.5  # rad of the second joint once the task is done


def _fitted(lifted: float, goes_on: bool = False) -> tuple[PolicyNetwork, tuple[int, int]]:
    train, validation = (toy_dataset(CONFIG, (60,) * 8, seed) for seed in (0, 1))
    for windows in (train, validation):
        windows.recorded.state[windows.recorded.done, 1] += lifted
        windows.recorded.succeeded[:] = windows.recorded.done & goes_on
    policy = toy_policy(CONFIG, train).eval().requires_grad_(False)
    return policy, fit_end(policy, train, validation, seed=0)


def test_a_policy_is_done_once_it_has_looked_so_for_a_while() -> None:
    (policy, ended), (again, _) = _fitted(LIFTED), _fitted(LIFTED)
    assert ended == (8, 8)
    for name, value in policy.state_dict().items():  # the same seed, the same output
        assert torch.equal(value, again.state_dict()[name])
    actor, tick = LearnedPolicy(policy, None), toy_observations(1)[0]
    tick[ft.TCP_POSE][:] = 0

    def said(joint: float, ticks: int) -> list[bool]:
        tick[ft.STATE] = np.zeros(15, np.float32)
        tick[ft.STATE][1] = joint
        return [actor.act(dict(tick)) is not None and actor.done for _ in range(ticks)]

    actor.reset()
    assert not any(said(0.0, 20) + said(LIFTED, 12) + said(0.0, 6))  # 0.6 s are too short
    assert said(LIFTED, 24)[-4:] == [True] * 4
    moved = actor.act(dict(tick))[:7].any()
    actor = LearnedPolicy(_fitted(LIFTED, goes_on=True)[0], None)
    assert moved and said(LIFTED, 12)[-1] and not actor.act(dict(tick))[:7].any()
    actor.config = replace(actor.config, gripper_changes=1)
    assert not said(LIFTED, 24)[-1]  # an end before the hand has let go is none
    actor.reset()
    assert not actor.done


def test_actions_after_success_are_not_taught() -> None:
    recorded = toy_dataset(CONFIG, (60,)).recorded
    recorded.succeeded[40:] = True
    padded = SequenceDataset(recorded, CONFIG).action_is_pad
    assert [padded[t].int().argmax().item() for t in (33, 36, 40)] == [7, 4, 0]
    assert not padded[:33].any() and padded[40:].all()


def test_ends_that_look_like_what_comes_before_are_not_told() -> None:
    policy, ended = _fitted(0.0)
    actor = LearnedPolicy(policy, None)
    assert ended == (0, 8) and policy.end and policy.end.limit == torch.inf
    assert not any(actor.act(tick) is None or actor.done for tick in toy_observations(40))


class DoneAtOnce:
    """Stands, and says that it is done."""

    def reset(self) -> None:
        self.done = False

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self.done = True
        return np.append(np.zeros(7, np.float32), observation[ft.STATE][-1])


def test_a_false_end_is_a_failure_of_its_own() -> None:
    config = PickPlaceConfig(cameras=(), tactile=False)
    trial = touchgoal.evaluate(DoneAtOnce, config, episodes=1).trials[0]
    assert (trial.success, trial.failure, trial.late) == (False, FALSELY_DONE, None)
    assert trial.seconds < 1.2  # a tick, and a second to see the outcome

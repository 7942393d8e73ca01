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
LENGTHS = (60,) * 8
LIFTED = 0.5  # rad of the second joint once the task is done


def _recorded(seed: int, shows: bool) -> SequenceDataset:
    windows = toy_dataset(CONFIG, LENGTHS, seed)
    if shows:
        windows.recorded.state[windows.recorded.done, 1] = LIFTED
    return windows


def _fitted(shows: bool) -> tuple[PolicyNetwork, tuple[int, int]]:
    windows = _recorded(0, shows)
    policy = toy_policy(CONFIG, windows).eval().requires_grad_(False)
    return policy, fit_end(policy, windows, _recorded(1, shows), seed=0)


def test_a_policy_is_done_once_it_has_looked_so_for_a_while() -> None:
    policy, ended = _fitted(shows=True)
    assert ended == (8, 8)
    again, _ = _fitted(shows=True)
    assert policy.end and again.end  # the same seed, the same output
    for one, other in zip(
        policy.end.state_dict().values(), again.end.state_dict().values(), strict=True
    ):
        assert torch.equal(one, other)
    actor, tick = LearnedPolicy(policy, None), toy_observations(1)[0]

    def ends_after(joint: float, ticks: int) -> list[bool]:
        said = []
        for _ in range(ticks):
            state = np.zeros(15, np.float32)
            state[1] = joint
            actor.act({**tick, ft.STATE: state, ft.TCP_POSE: np.zeros(7, np.float32)})
            said.append(actor.done)
        return said

    actor.reset()
    assert not any(ends_after(0.0, 20))
    assert not any(ends_after(LIFTED, 12)) and not any(ends_after(0.0, 6))  # 0.6 s are too short
    assert ends_after(LIFTED, 24)[-4:] == [True] * 4
    actor.reset()
    assert not actor.done


def test_ends_that_look_like_what_comes_before_are_not_told() -> None:
    policy, ended = _fitted(shows=False)
    assert ended == (0, 8) and policy.end and policy.end.limit == torch.inf
    actor = LearnedPolicy(policy, None)
    for tick in toy_observations(40):
        actor.act(tick)
        assert not actor.done


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
    assert not trial.success and trial.failure == FALSELY_DONE
    assert trial.seconds < 1.2  # a tick, and a second to see the outcome

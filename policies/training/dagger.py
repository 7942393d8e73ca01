"""Demonstrations by an expert that labels any state, also while a policy acts (DAgger)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.interfaces import Actor
from touchgoal.episodes.recording import EpisodeSpec
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.by_name import choose_policy
from touchgoal.policies.checkpoint import SavedPolicy
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import PickPlaceConfig, TaskConfig
from touchgoal.sim_envs.experts.pick_place_feedback import FeedbackExpert
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.tasks import make_expert

# Standard deviations of the noise on `features.TRUTH_START`: m, and cosine and sine of twice the
# yaw. A little above the errors of the shipped pose estimator (`estimator.json`).
_START_ERROR = np.array([0.003, 0.003, 0.0015, 0.03, 0.03, 0.0015, 0.0015])


@dataclass(frozen=True)
class DaggerRoles:
    """Actor and expert of a recording, see `Roles` in `episodes/recording.py`."""

    # makes the policy that acts while the expert's actions are recorded (DAgger, Ross et al. 2011);
    # a policy with a state estimator gets true states with noise. None: the expert itself acts
    policy: Callable[[Any], Actor] | None = None

    def __call__(self, env: FrankaTactileEnv, spec: EpisodeSpec) -> tuple[Actor, Actor]:
        """Return the actor, and the expert whose actions are recorded."""
        expert = FeedbackExpert(env) if isinstance(env, PickPlace) else make_expert(env)
        if (policy := self.policy) is None:
            return expert, expert
        if isinstance(policy, SavedPolicy) and isinstance(env, PickPlace) and policy.is_estimated:
            truth = _NoisyTruth(env)
            return LearnedPolicy(policy.network(), None, truth, env.plan_ticks), expert
        actor = policy(env)
        if isinstance(actor, LearnedPolicy):  # it must learn from novel states
            actor.refuses_novelty = False
        return actor, expert


def dagger_roles(policy: str | None, task: TaskConfig, feedback: bool) -> DaggerRoles:
    """Return the roles of a recording by an expert that gives an action at every tick.

    UserError: the policy or the expert cannot act in the task.
    """
    if feedback and not isinstance(task, PickPlaceConfig):
        raise UserError("--feedback is for pick-place: the other experts always have feedback")
    if isinstance(task, PickPlaceConfig) and task.release:
        raise UserError("--env.release needs the planned expert: leave out --feedback and --policy")
    if policy is None or policy == "expert":
        return DaggerRoles()
    maker, needed = choose_policy(policy, task)
    if isinstance(maker, SavedPolicy) and maker.is_estimated:
        return DaggerRoles(maker)
    missing = [f"the {name} camera" for name in needed.cameras if name not in task.cameras]
    missing += ["the fingertips"] * (needed.tactile and not task.tactile)
    if missing:
        raise UserError(
            f"the policy reads {missing[0]}: record that too (--env.cameras, --env.tactile)"
        )
    return DaggerRoles(maker)


class _NoisyTruth:
    """Ground truth with an error that is constant within an episode, as a pose estimator's is."""

    def __init__(self, env: PickPlace) -> None:
        self._env = env
        error = env.np_random.spawn(1)[0].normal(0, _START_ERROR)
        self._start = (env.start + error).astype(np.float32)

    def estimate(
        self, observation: Mapping[str, np.ndarray], first: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See StateEstimator."""
        contact = np.array([pad.touching for pad in self._env.observed_contacts()], np.float32)
        return {ft.TRUTH_CONTACT: contact, ft.TRUTH_START: self._start}

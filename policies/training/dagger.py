"""Demonstrations by laws of the present state, to a learner too that acts by itself."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from touchgoal.control import features as ft
from touchgoal.episodes.recording import Actor, EpisodeSpec
from touchgoal.policies import checkpoint
from touchgoal.policies.acting import Planner, PolicyActor, SavedPolicy
from touchgoal.sim_envs.base import FrankaTactileEnv
from touchgoal.sim_envs.experts.pick_place_feedback import FeedbackExpert
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.tasks import make_expert


@dataclass(frozen=True)
class DaggerRoles:
    """Roles (see `episodes/recording.py`) of an expert to be asked in any state, and its learner.

    Attributes:
        learner: directory of a policy that acts while the expert says what it should have done
            (DAgger, Ross et al. 2011), on the simulator's truth in place of its senses, if it has
            some; None: the expert itself acts.
    """

    learner: Path | None = None

    def __call__(self, env: FrankaTactileEnv, spec: EpisodeSpec) -> tuple[Actor, Actor]:
        """Who acts, and whose answers are recorded."""
        expert = FeedbackExpert(env) if isinstance(env, PickPlace) else make_expert(env)
        if self.learner is None:
            return expert, expert
        policy = checkpoint.load(self.learner, control_hz=env.config.control_hz)
        if policy.config.estimated and isinstance(env, PickPlace):
            return PolicyActor(Planner(policy, None, _TrueState(env))), expert
        return SavedPolicy(self.learner).check_task(env.config)(), expert


class _TrueState:
    """A state estimator that asks the simulator."""

    def __init__(self, env: PickPlace) -> None:
        self._env = env

    def estimate(
        self, observation: Mapping[str, np.ndarray], first: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See StateEstimator."""
        contact = np.array([pad.touching for pad in self._env.pad_contacts()], np.float32)
        return {ft.TRUTH_CONTACT: contact, ft.TRUTH_START: self._env.start}

"""Acting by plans: the policy as an actor in an environment or on the arm."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.policies.perception.end_to_end import difference_images
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.policies.perception.proprioception import tare
from touchgoal.policies.policy import ObservationBatch, Policy
from touchgoal.runtime.errors import UserError


@runtime_checkable
class Estimator(Protocol):
    """A state estimator, or what stands for one."""

    def estimate(
        self, observation: Observation, first: Observation
    ) -> dict[str, Float32[np.ndarray, " n"]]:
        """See StateEstimator."""
        ...


class Planner:
    """From the last observations of an episode to a plan.

    The same seed and observations give the same plans.

    Attributes:
        config: of the policy.
        touch: embedder of the fingertips.
        ticks_seen: observations to be handed over: the policy's own, and those before them that the embedder looks
            back to.
    """

    def __init__(
        self,
        policy: Policy,
        touch: TouchEmbedder | None,
        estimator: Estimator | None = None,
        seed: int = 0,
    ) -> None:
        """For one episode.

        Args:
            policy: for inference.
            touch: embedder of the training; None for a policy without touch.
            estimator: reads the columns that only a simulator knows; None if there are none.
            seed: of the plans' noise.

        Raises:
            UserError: the embedder is not the training's, or an estimator is missing.
        """
        self.config = config = policy.config
        if (touch.name if touch else "") != config.touch:
            raise UserError(
                f"the policy was trained with the touch encoder {config.touch or 'none'}, this is "
                f"{touch.name if touch else 'none'}: load the one that it was trained with"
            )
        if config.estimated and estimator is None:
            raise UserError(f"the policy acts on {config.estimated[0]}: give it a state estimator")
        self._policy, self.touch, self._estimator = policy, touch, estimator
        self.ticks_seen = config.observation_horizon + (touch.reach if touch else 0)
        self.reset(seed)

    def reset(self, seed: int = 0) -> None:
        """Begin another episode; `seed` is of its plans' noise."""
        self._generator = torch.Generator().manual_seed(seed)
        self._first: Observation = {}
        self._embedded: list[tuple[Observation, np.ndarray, np.ndarray]] = []

    def prepare_thread(self) -> None:
        """Limit torch to one thread in the planning thread: two lose when the other core is taken."""
        torch.set_num_threads(1)

    def plan(self, seen: Sequence[Observation]) -> Float32[np.ndarray, "h 8"]:
        """Actions from the latest observation on.

        Args:
            seen: the last `ticks_seen` observations, oldest first. The oldest one of the first
                call is the episode's first, untouched one.
        """
        self.embed(seen)
        _, touch, state = zip(*self._embedded, strict=True)
        touch, state = (torch.from_numpy(np.stack(x)).float()[None] for x in (touch, state))
        batch = ObservationBatch(touch, state, self._difference_images(seen[-1]))
        return self._policy.plan(batch, self._generator)[0].numpy()

    def embed(self, seen: Sequence[Observation]) -> None:
        """Embed these ahead of a `plan` that begins with some of them: most of the work."""
        self._first = self._first or seen[0]
        ends = range(len(seen) - self.config.observation_horizon + 1, len(seen) + 1)
        self._embedded = [(seen[end - 1], *self._embed_tick(seen[:end])) for end in ends]

    def _embed_tick(self, seen: Sequence[Observation]) -> tuple[np.ndarray, np.ndarray]:
        """The embedding (e,) and the proprioception (s,) of the newest tick."""
        observation = seen[-1]
        for before, touch, state in self._embedded:
            if before is observation:
                return touch, state
        known = dict(observation)
        if self._estimator:
            known |= self._estimator.estimate(observation, self._first)
        if ft.WRENCH in self.config.proprioception:
            known[ft.WRENCH] = tare(observation[ft.WRENCH], self._first[ft.WRENCH])
        state = np.concatenate([known[key] for key in self.config.proprioception])
        return self._embed_touch(seen), state

    def _embed_touch(self, seen: Sequence[Observation]) -> Float32[np.ndarray, " e"]:
        if self.touch is None:
            return np.empty(0, np.float32)
        return self.touch.embed_tick(seen, self._first)

    def _difference_images(self, observation: Observation) -> UInt8[Tensor, "1 k h w 3"] | None:
        end_to_end = self.config.end_to_end
        if end_to_end is None:
            return None
        pictures = [
            difference_images(observation[k][None], self._first[k], end_to_end.size)
            for k in ft.TACTILE
        ]
        return torch.from_numpy(np.stack(pictures, 1))


class PolicyActor:
    """Does `execution_horizon` ticks of a plan, then the next plan's.

    An inference that takes `plan_ticks` control ticks is asked for so much earlier, and the ticks that have
    gone by when its plan arrives are left out: no tick is done twice, none waits.
    """

    def __init__(self, planner: Planner, plan_ticks: int = 0) -> None:
        """Starts an episode.

        Args:
            planner: of this episode.
            plan_ticks: ticks from an observation to its plan. On the first tick the arm stands, and
                the plan is waited for.

        Raises:
            UserError: plans too short to come so late.
        """
        config = planner.config
        spare = config.prediction_horizon - config.execution_horizon
        if not 0 <= plan_ticks <= min(spare, config.execution_horizon):
            raise UserError(
                f"a plan of {config.prediction_horizon} ticks, {config.execution_horizon} of them "
                f"done, cannot come {plan_ticks} ticks late: change execution_horizon"
            )
        self._planner, self._plan_ticks = planner, plan_ticks
        self._seen: list[Observation] = []
        self._todo: list[np.ndarray] = []  # actions of the present plan
        self._next: list[np.ndarray] = []  # of the one that is on its way

    def act(self, observation: Observation) -> Float32[np.ndarray, "8"]:
        """The action for the next tick."""
        config, first = self._planner.config, not self._seen
        before = self._seen or [observation] * self._planner.ticks_seen
        self._seen = [*before[1:], observation]
        if first:
            self._todo = list(self._planner.plan(self._seen)[: config.execution_horizon])
        self._take_over()
        if len(self._todo) == self._plan_ticks:
            upto = self._plan_ticks + config.execution_horizon
            self._next = list(self._planner.plan(self._seen)[self._plan_ticks : upto])
            self._take_over()
        return self._todo.pop(0)

    def _take_over(self) -> None:
        """Go on with the next plan where the present one is done."""
        if not self._todo:
            self._todo, self._next = self._next, []

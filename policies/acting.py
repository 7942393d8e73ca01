"""Acting by plans: the policy as an actor in an environment or on the arm."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from touchgoal.control import vocabulary as v
from touchgoal.control.errors import UserError
from touchgoal.policies import checkpoint
from touchgoal.policies.policy import Condition, Policy
from touchgoal.policies.touch import TouchEmbedder, load_touch


class PolicyActor:
    """Does `execution_horizon` ticks of a plan, then the next plan's.

    An inference that takes `latency` ticks is asked for so much earlier, and the ticks that have
    gone by when its plan arrives are left out: no tick is done twice, none waits. The same seed and
    observations give the same actions.
    """

    def __init__(
        self, policy: Policy, touch: TouchEmbedder | None, seed: int = 0, latency: int = 0
    ) -> None:
        """Starts an episode.

        Args:
            policy: for inference.
            touch: embedder of the training; None for a policy without touch.
            seed: of the plans' noise.
            latency: ticks from an observation to its plan. On the first tick the arm stands, and
                the plan is waited for.

        Raises:
            UserError: the embedder is not the training's, or plans too short for the latency.
        """
        config = policy.config
        if (touch.name if touch else "") != config.touch:
            raise UserError(
                f"the policy feels through {config.touch!r}, not {touch.name if touch else ''!r}: "
                "load the touch encoder that it was trained with"
            )
        spare = config.prediction_horizon - config.execution_horizon
        if not 0 <= latency <= min(spare, config.execution_horizon):
            raise UserError(
                f"a plan of {config.prediction_horizon} ticks, {config.execution_horizon} of them "
                f"done, cannot come {latency} ticks late: change execution_horizon"
            )
        self._policy, self._touch, self._latency = policy, touch, latency
        self._generator = torch.Generator().manual_seed(seed)
        self._untouched: Mapping[str, np.ndarray] = {}
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []
        self._todo: list[np.ndarray] = []  # actions of the present plan
        self._next: list[np.ndarray] = []  # of the one that is on its way

    def act(self, observation: Mapping[str, np.ndarray]) -> Float32[np.ndarray, "8"]:
        """The action for the next tick."""
        config, first = self._policy.config, not self._seen
        self._see(observation)
        if first:
            self._todo = self._plan()[: config.execution_horizon]
        self._take_over()
        if len(self._todo) == self._latency:
            upto = self._latency + config.execution_horizon
            self._next = self._plan()[self._latency : upto]
            self._take_over()
        return self._todo.pop(0)

    def _take_over(self) -> None:
        """Go on with the next plan where the present one is done."""
        if not self._todo:
            self._todo, self._next = self._next, []

    def _plan(self) -> list[np.ndarray]:
        touch, state = (torch.from_numpy(np.stack(rows)) for rows in zip(*self._seen, strict=True))
        condition = Condition(touch.float()[None], state.float()[None])
        return list(self._policy.plan(condition, self._generator)[0].numpy())

    def _see(self, observation: Mapping[str, np.ndarray]) -> None:
        config = self._policy.config
        state = np.concatenate([observation[key] for key in config.proprioception])
        touch = np.empty(0, np.float32)
        if self._touch:
            self._untouched = self._untouched or {key: observation[key] for key in v.TACTILE}
            touch = self._touch.embed_tick(observation, self._untouched)
        before = self._seen or [(touch, state)] * config.observation_horizon
        self._seen = [*before[1:], (touch, state)]


@dataclass(frozen=True)
class ActorMaker:
    """Makes actors of a policy on disk, in any process.

    Attributes:
        directory: of the policy, with its touch encoder in `touch/`.
        seed: of the plans' noise.
        latency: see `PolicyActor`.
    """

    directory: Path
    seed: int = 0
    latency: int = 0

    def __call__(self, env: object = None) -> PolicyActor:
        """An actor for one episode, on one core; whose environment does not matter."""
        torch.set_num_threads(1)  # two lose badly when the other core is taken
        policy = checkpoint.load(self.directory)
        touch = load_touch(self.directory / checkpoint.TOUCH) if policy.config.touch_dim else None
        return PolicyActor(policy, touch, self.seed, self.latency)

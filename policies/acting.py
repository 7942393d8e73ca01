"""Acting by plans: the policy as an actor in an environment or on the arm."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32

from touchgoal.policies.policy import Condition, Policy

EmbedTick = Callable[[dict[str, np.ndarray]], Float32[np.ndarray, " e"]]


class PolicyActor:
    """Does `execution_horizon` ticks of a plan, then plans again, waiting for it.

    The same seed and observations give the same actions.
    """

    def __init__(self, policy: Policy, embed: EmbedTick | None, seed: int = 0) -> None:
        """Starts an episode.

        Args:
            policy: for inference.
            embed: an observation to the embedding of both fingertips, the one of training; None
                for a policy without touch.
            seed: of the plans' noise.
        """
        self._policy, self._embed = policy, embed
        self._generator = torch.Generator().manual_seed(seed)
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []
        self._plan: list[np.ndarray] = []

    def act(self, observation: dict[str, np.ndarray]) -> Float32[np.ndarray, "8"]:
        """The action for the next tick."""
        config = self._policy.config
        self._see(observation)
        if not self._plan:
            actions = self._policy.plan(self._condition(), self._generator)[0]
            self._plan = list(actions[: config.execution_horizon].numpy())
        return self._plan.pop(0)

    def _see(self, observation: dict[str, np.ndarray]) -> None:
        config = self._policy.config
        state = np.concatenate([observation[key] for key in config.proprioception])
        touch = self._embed(observation) if self._embed else np.empty(0, np.float32)
        before = self._seen or [(touch, state)] * config.observation_horizon
        self._seen = [*before[1:], (touch, state)]

    def _condition(self) -> Condition:
        touch, state = (torch.from_numpy(np.stack(rows)) for rows in zip(*self._seen, strict=True))
        assert touch.shape[1] == self._policy.config.touch_dim, "the embedder is of another policy"
        return Condition(touch.float()[None], state.float()[None])

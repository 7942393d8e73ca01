"""Whether the task is done, read out of what a policy's head reads."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.policies.heads.mlp import readout

END_SECONDS = 0.5  # s at the end of a successful recording in which the task is done
LEAVING_SECONDS = 1.5  # s, the same by sight: a hand that leaves slows down where it stops
# s for which its probability must last in recordings, which stop soon after the end; for a policy this is
# enough where they go on after success. Elsewhere an object that hovers over its place looks nearly done.
LASTING, _DONE_SECONDS = 0.3, 0.8
_WIDTH = 64


class EndOutput(nn.Module):
    """Probability that the task is done; above `limit` it counts as done.

    It is fitted to a trained policy (`training/end.py`), which it leaves as it is. Until then, and where
    the end looks like what comes before, the limit is infinite.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        # an input of infinite scale is not read
        self.mean, self.scale = nn.Buffer(torch.zeros(inputs)), nn.Buffer(torch.ones(inputs))
        self.limit = nn.Buffer(torch.tensor(torch.inf))
        # whether the recordings go on after success: no motion is taught there, so the arm stands still
        self.stands = nn.Buffer(torch.tensor(False))
        self.network = readout(inputs, _WIDTH, 1).requires_grad_(False)

    @property
    def seconds(self) -> float:
        """Return for how long a policy must find the task done, s."""
        return LASTING if self.stands else _DONE_SECONDS

    def scaled(self, condition: Float[Tensor, "b c"]) -> Float[Tensor, "b c"]:
        """Return what the network reads: of variance 1, without extremes."""
        return ((condition - self.mean) / self.scale).clamp(-5, 5)

    def forward(self, condition: Float[Tensor, "b c"]) -> Float[Tensor, " b"]:
        """Return the probability."""
        return self.network(self.scaled(condition))[:, 0].sigmoid()

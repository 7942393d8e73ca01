"""Running average of an episode's key pose estimates."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from touchgoal.policies.sight.estimates import ESTIMATE_DIM, FIXED, GROUPS, likeliest, to_frame
from touchgoal.policies.sight.key_pose import HOLD_SECONDS, nearness
from touchgoal.policies.sight.readout import COUNT, repeated

_MEMORY = 1.0  # s after which an estimate weighs 1/e in the average


class KeyPoseAverage:
    """Running average of an episode's estimates, because the hand hides its goal from the cameras.

    The average is taken in the base frame. After the gripper changes, the key pose after it becomes
    the next one.
    """

    def __init__(self, plan_seconds: float) -> None:
        """Begin an episode with an estimate every `plan_seconds`."""
        self._keep = math.exp(-plan_seconds / _MEMORY)
        self._hold = math.ceil(HOLD_SECONDS / plan_seconds)
        self._moving = 0  # estimates still to come while the fingers move
        self._tcp: Float[Tensor, "1 7"] | None = None  # at the latest estimate
        self._changed: Float[Tensor, "1 7"] | None = None  # where the gripper last changed
        self._left: Float[Tensor, "1 7"] | None = None  # the same, once the fingers have moved
        self._weight = torch.zeros(COUNT, len(GROUPS))
        self._mean = torch.zeros(COUNT, ESTIMATE_DIM + 1)

    @property
    def gripper_moves(self) -> bool:
        """Return whether the gripper was commanded to change within `HOLD_SECONDS`."""
        return self._moving > 0

    def change_gripper(self) -> None:
        """Note that the gripper changes: once the fingers have moved, the following key pose is next."""
        self._moving, self._changed = self._hold, self._tcp

    def add(
        self,
        estimate: Float[Tensor, "1 2 11"],
        weight: Float[Tensor, "1 2 5"],
        tcp: Float[Tensor, "1 7"],
    ) -> Float[Tensor, "1 11"]:
        """Add weighted estimates in the hand's frame; return the average in the form of `true_pose`."""
        fixed, hand = torch.tensor([FIXED]).expand(COUNT, 7), tcp.expand(COUNT, 7)
        if not self.gripper_moves:
            fixed_estimate = to_frame(fixed, estimate[0, :, :-1], hand)
            fixed_estimate = torch.cat([fixed_estimate, estimate[0, :, -1:]], 1)
            self._weight = self._weight * self._keep + weight[0]
            share = repeated(weight[0] / self._weight)
            self._mean = torch.lerp(self._mean, fixed_estimate, torch.cat([share, share[:, :1]], 1))
        found = to_frame(hand[:1], self._mean[:1, :-1], fixed[:1])
        closes = (self._mean[:1, -1:] > 0.5).float()
        near = torch.zeros(1, 1) if self._left is None else nearness(tcp, self._left[:, :3])
        if self._moving == 1:
            self._mean, self._left = self._mean[[1, 1]], self._changed
            self._weight = torch.stack([self._weight[1], torch.zeros(len(GROUPS))])
        self._moving, self._tcp = max(self._moving - 1, 0), tcp
        return torch.cat([likeliest(found), closes, near], 1)

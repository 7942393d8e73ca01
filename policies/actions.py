"""Chunks of actions: their representations, and normalisation.

An action (8,) is the joint change (7) of one tick, rad, and the gripper width target, m
(`features.ACTION`). A chunk, or plan, is the actions of h ticks from the latest observation on. A
network predicts it in a representation, each tick normalised by itself.
"""

from functools import cache

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from touchgoal.control.features import N_JOINTS
from touchgoal.control.motion.kinematics import DAMPING, Kinematics
from touchgoal.control.safety.limits import FR3
from touchgoal.policies.config import ActionRepresentation

ACTION_DIM = N_JOINTS + 1

_MIN_RANGE = 1e-6  # SI units; a component that varies less counts as constant
_QUANTILE_ROWS = 20_000  # values of each component whose quantiles are taken


def to_representation(
    actions: Float[Tensor, "b h 8"], joints: Float[Tensor, "b 7"], kind: ActionRepresentation
) -> Float[Tensor, "b h 8"]:
    """Return actions in a representation; `joints` (rad) are measured at the chunk's start."""
    if kind == "delta":
        return actions
    targets = actions[..., :N_JOINTS].cumsum(1)
    if kind == "base_twist":
        targets = targets @ _base_jacobian_and_elbow(joints).mT
    if kind == "body_twist":
        targets = F.pad(targets @ body_jacobian(joints).mT, (0, 1))
    if kind == "absolute":
        targets = joints[:, None] + targets
    return torch.cat([targets, actions[..., N_JOINTS:]], -1)


def to_actions(
    represented: Float[Tensor, "b h 8"], joints: Float[Tensor, "b 7"], kind: ActionRepresentation
) -> Float[Tensor, "b h 8"]:
    """Invert `to_representation`."""
    if kind == "delta":
        return represented
    targets = represented[..., :N_JOINTS]
    if kind == "base_twist":
        targets = torch.linalg.solve(_base_jacobian_and_elbow(joints), targets.mT).mT
    if kind == "body_twist":
        targets = targets[..., :6] @ _damped_pseudoinverse(body_jacobian(joints)).mT
    start = joints if kind == "absolute" else torch.zeros_like(joints)
    changes = torch.cat([targets[:, :1] - start[:, None], targets.diff(dim=1)], 1)
    return torch.cat([changes, represented[..., N_JOINTS:]], -1)


def _base_jacobian_and_elbow(joints: Float[Tensor, "b 7"]) -> Float[Tensor, "b 7 7"]:
    """Return the Jacobian of the hand's displacement and rotation, with the third joint as a row."""
    _, _, rows = _kinematics().forward_many(joints.cpu().numpy().astype(np.float64))
    elbow = torch.eye(N_JOINTS)[2].expand(len(rows), 1, -1)
    return torch.cat([torch.from_numpy(rows).float(), elbow], 1).to(joints)


def body_jacobian(joints: Float[Tensor, "*b 7"]) -> Float[Tensor, "*b 6 7"]:
    """Return the Jacobian of the TCP's displacement and rotation along its own axes."""
    columns = joints.reshape(-1, N_JOINTS).cpu().numpy().astype(np.float64)
    _, R, J = _kinematics().forward_many(columns)
    own = R.mT[:, None] @ J.reshape(-1, 2, 3, N_JOINTS)
    return torch.from_numpy(own).float().to(joints).reshape(*joints.shape[:-1], 6, N_JOINTS)


def tcp_poses(joints: Float[Tensor, "*b 7"]) -> Float[Tensor, "*b 7"]:
    """Return `features.TCP_POSE` at joint positions (rad)."""
    position, R, _ = _kinematics().forward_many(
        joints.reshape(-1, N_JOINTS).cpu().numpy().astype(np.float64)
    )
    quaternions = Rotation.from_matrix(R).as_quat(scalar_first=True)
    poses = np.concatenate([position, quaternions], 1)
    return torch.from_numpy(poses).to(joints).reshape(joints.shape)


def _damped_pseudoinverse(J: Float[Tensor, "b 6 7"]) -> Float[Tensor, "b 7 6"]:
    """Return the matrix from displacement and rotation to the least joint change."""
    return J.mT @ torch.linalg.inv(J @ J.mT + DAMPING * torch.eye(6).to(J))


@cache
def _kinematics() -> Kinematics:
    return FR3.kinematics()


class Normalizer(nn.Module):
    """Affine map of every component to a network's range, and back.

    A constant component becomes 0, and comes back as the constant.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.offset, self.scale = nn.Buffer(torch.zeros(shape)), nn.Buffer(torch.ones(shape))

    def fit_range(
        self,
        values: Float[Tensor, "n ..."],
        valid: Bool[Tensor, "n ..."] | None = None,
        share: float = 1.0,
    ) -> None:
        """Map the least and the greatest of these values to -1 and 1.

        Only `valid` values count, if given; a component without any becomes 0. With a `share` below
        1 it is the range of the middle share, so that rare large values do not make the others tiny;
        a component that varies only outside it, such as a gripper's, keeps the whole range.
        """
        if valid is None:
            valid = torch.ones_like(values, dtype=torch.bool)
        low = values.masked_fill(~valid, torch.inf).amin(0)
        high = values.masked_fill(~valid, -torch.inf).amax(0)
        if share < 1.0:
            some = values.masked_fill(~valid, torch.nan)[:: max(1, len(values) // _QUANTILE_ROWS)]
            ends = torch.tensor([(1 - share) / 2, (1 + share) / 2])
            inner = torch.nanquantile(some.flatten(1), ends, dim=0).unflatten(1, values.shape[1:])
            wide = inner[1] - inner[0] > _MIN_RANGE
            low, high = torch.where(wide, inner[0], low), torch.where(wide, inner[1], high)
        none = ~valid.expand_as(values).any(0)
        low, high = low.masked_fill(none, 0.0), high.masked_fill(none, 0.0)
        self._set((low + high) / 2, (high - low) / 2)

    def fit_mean_std(self, values: Float[Tensor, "n ..."]) -> None:
        """Map these values to mean 0 and variance 1."""
        self._set(values.mean(0), values.std(0, correction=0))

    def forward(self, values: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Map to the network's range."""
        constant = self.scale == 0
        return (values - self.offset) * ~constant / (self.scale + constant)

    def inverse(self, scaled: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Map back from it."""
        return scaled * self.scale + self.offset

    def _set(self, offset: Tensor, scale: Tensor) -> None:
        self.offset.copy_(offset)
        self.scale.copy_(torch.where(scale < _MIN_RANGE, 0.0, scale))

"""Estimates of hand poses that can be averaged, over cameras and over time.

An estimate (10) is a position (m), the approach (the hand's z axis), and the cosine and sine of twice and of
four times the rotation about the approach. A parallel gripper that is rotated by half a turn grasps the same:
twice the angle is equal for both (Morrison et al. 2018). A box can be grasped across either pair of faces, a
quarter turn apart: there the means of twice the angle vanish, and those of four times the angle remain. A mean
of the angles themselves would lie between them, across the corners.

Estimates are expressed in a frame: that of the present hand, or `FIXED`, which lies at the base with the
fingers down.
"""

import math
from functools import cache

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from touchgoal.policies.perception.proprioception import rotation_6d

ESTIMATE_DIM = 10
# across the frame's z axis and along it (m), approach, twice and four times the turn
GROUPS = 2, 1, 3, 2, 2
SCALES = 0.05, 0.05, 0.3, 0.6, 1.2  # errors that weigh alike: m, m, rad, and rad of the multiples
FIXED = 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0  # a pose: position (m), quaternion (wxyz)
_DEGREES = 180  # candidate turns, a degree apart: half a turn in all
# bonus of the present rotation, as a share of a certain estimate: of two equals the nearer one stays
_STAY = 0.1


def estimate_from(frame: Float[Tensor, "b 7"], pose: Float[Tensor, "b 7"]) -> Float[Tensor, "b 10"]:
    """Express a pose as an estimate in `frame`; both are poses in the base frame."""
    axes = _axes(frame)
    there = axes.mT @ _axes(pose)
    turn = _reference(there[:, :, 2]).mT @ there  # about z
    once = torch.complex(turn[:, 0, 0], turn[:, 1, 0])
    multiples = torch.view_as_real(torch.stack([once**2, once**4], 1)).flatten(1)
    place = ((pose[:, :3] - frame[:, :3])[:, None] @ axes)[:, 0]
    return torch.cat([place, there[:, :, 2], multiples], 1)


def to_frame(
    frame: Float[Tensor, "b 7"], estimate: Float[Tensor, "b 10"], before: Float[Tensor, "b 7"]
) -> Float[Tensor, "b 10"]:
    """Express estimates, given in the frame `before`, in `frame`."""
    to, place = _axes(frame).mT @ _axes(before), estimate[:, :3, None]
    place = to @ place + _axes(frame).mT @ (before - frame)[:, :3, None]
    z = F.normalize(estimate[:, 3:6], dim=1)
    approach = (to @ z[:, :, None])[..., 0]
    cos, sin = (_reference(approach).mT @ to @ _reference(z))[:, :2, 0].unbind(1)
    shift = torch.complex(cos, sin)
    multiples = torch.view_as_complex(estimate[:, 6:].unflatten(1, (2, 2)).contiguous())
    multiples = multiples * torch.stack([shift**2, shift**4], 1)
    turned = torch.view_as_real(multiples).flatten(1)
    return torch.cat([place[..., 0], approach * estimate[:, 3:6].norm(dim=1)[:, None], turned], 1)


def likeliest(estimate: Float[Tensor, "b 10"]) -> Float[Tensor, "b 9"]:
    """Return the likeliest pose: position and two columns of the rotation, at most a quarter turn away."""
    turns, columns = _turns()
    weight = estimate[:, 6:] + torch.tensor([_STAY, 0.0, 0.0, 0.0]).to(estimate)
    turn = turns.to(estimate)[(weight @ columns.to(estimate)).argmax(1)]
    R = _reference(F.normalize(estimate[:, 3:6], dim=1))
    cos, sin = turn.cos()[:, None], turn.sin()[:, None]
    x, y = R[:, :, 0] * cos + R[:, :, 1] * sin, R[:, :, 1] * cos - R[:, :, 0] * sin
    return torch.cat([estimate[:, :3], x, y], 1)


@cache
def _turns() -> tuple[Float[Tensor, " t"], Float[Tensor, "4 t"]]:
    """Return turns of up to a quarter turn either way, rad, with cosines and sines of their multiples."""
    turns = (torch.arange(_DEGREES) - _DEGREES / 2 + 0.5) * math.pi / _DEGREES
    return turns, torch.stack([f(n * turns) for n in (2, 4) for f in (torch.cos, torch.sin)])


def _reference(approach: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """Return the least rotation that turns z to a unit vector; not defined for the opposite one."""
    x, y, z = approach.unbind(1)
    k = 1 / (1 + z).clamp(min=1e-3)
    first = torch.stack([1 - k * x * x, -k * x * y, -x], 1)
    second = torch.stack([-k * x * y, 1 - k * y * y, -y], 1)
    return torch.stack([first, second, approach], 2)


def _axes(pose: Float[Tensor, "b 7"]) -> Float[Tensor, "b 3 3"]:
    """Return the axes of poses in the base frame, as columns."""
    x, y = rotation_6d(pose[:, 3:]).split(3, 1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], 2)

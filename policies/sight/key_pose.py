"""The next key pose: where the hand will be when the gripper next opens or closes, or the task ends.

With it comes whether the gripper is closed afterwards: without that, the end of a task looks like the
place to grasp. The recordings hold both (keyframes: James and Davison 2022), and camera images show it. Taught it, a
policy learns where things are; trained on the actions alone, it memorises the recordings. The key pose
after it is predicted as well: later the hand and the object in it may hide that place.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.policies.sight.estimates import estimate_from, likeliest

KEY_POSE_DIM = 14  # of `features`
_POSE = 9  # position, and two columns of the rotation matrix
HOLD_SECONDS = 0.5  # s in which the fingers move
_LEVELS = 1e-3  # m between the least and the greatest commanded width: less is one width
_POSITION, _ROTATION = 0.05, 0.3  # m and rad that weigh alike
_NEAR = 0.02  # m; the second input grows fast below it, and hardly above
_NOISE = 0.003  # m and, of the rotation's columns, 1; on what the policy reads in training
_CLOSE = 0.1  # m from the key pose within which errors are corrected
_BESIDE = 0.02, 0.02, 0.01, 0.2  # m along the hand's axes, rad about its z axis
_BACK = 10  # ticks
_REACHED = 0.02  # m
_AT = math.sqrt(3) * _NOISE  # m; the training's noise: the head cannot tell it from there
_STILL = 0.0002  # m per tick


def key_poses(
    tcp: Float32[np.ndarray, "n 7"],
    widths: Float32[np.ndarray, " n"],
    lengths: Sequence[int],
    hold: int,
) -> Float32[np.ndarray, "n 3 8"]:
    """Return for every tick the TCP pose at the last change of the commanded width, and at the next ones.

    First that at the last change, and 1; before the first change the present one, and 0. Then that at the
    next change, or at the end, and 1 if the gripper is closed after it, else 0; and the same of the change
    that follows. An episode that ends open has let go: then the last change stays the next, for the hand
    above what it left looks like the hand above what it will grasp.

    Args:
        lengths: ticks of each episode, one after the other.
        hold: ticks for which a key pose stays the next after the change: until the fingers have moved,
            nothing shows that it was commanded.
    """
    closed = widths < (widths.min() + widths.max()) / 2
    ends = np.cumsum(lengths) - 1
    changes = np.flatnonzero(np.diff(closed)) if np.ptp(widths) > _LEVELS else np.empty(0, int)
    let_go = ~closed[ends] & np.isin(ends, ends[np.searchsorted(ends, changes)])
    keys = np.union1d(changes, ends[~let_go]).astype(np.int64)
    last = ends[np.searchsorted(ends, keys)]
    final = np.append(last[1:] != last[:-1], True)
    until = np.where(final, last, np.minimum(keys + hold, last))
    after = closed[np.minimum(keys + 1, last)].astype(np.float32)[:, None]
    poses = np.concatenate([tcp[keys], after], 1)
    poses = np.stack([poses, poses[np.arange(len(keys)) + ~final]], 1)
    tick = np.arange(len(tcp))
    before = np.append(changes, -1)[np.searchsorted(changes + hold, tick) - 1]
    known = before > np.repeat(ends - lengths, lengths)
    left = np.concatenate([tcp[np.where(known, before, tick)], known[:, None]], 1)
    return np.concatenate([left[:, None], poses[np.searchsorted(until, tick)]], 1, dtype=np.float32)


def true_pose(tcp: Float[Tensor, "b 7"], key: Float[Tensor, "b 3 8"]) -> Float[Tensor, "b 11"]:
    """Return what sight tells if it is perfect: the next key pose in the hand's frame, and what is around it.

    Position and two columns of the rotation; 1 if the gripper closes there; see `nearness` of the last one.
    """
    found = likeliest(estimate_from(tcp, key[:, 1, :7]))
    return torch.cat([found, key[:, 1, 7:], key[:, 0, 7:] * nearness(tcp, key[:, 0, :3])], 1)


def nearness(tcp: Float[Tensor, "b 7"], left: Float[Tensor, "b 3"]) -> Float[Tensor, "b 1"]:
    """Return how near the hand is to where the gripper last changed: from 1, there, to 0, far away.

    It shows whether a grasp is still to be left, where the way to the next key pose would be along the table.
    """
    away = (tcp[:, :3] - left).norm(dim=1, keepdim=True)
    return (-(away / _POSITION).square() / 2).exp()


def features(pose: Float[Tensor, "b 11"], noise: BatchNoise | None = None) -> Float[Tensor, "b 14"]:
    """Return a policy's input for `true_pose`, or what is seen of it, with the training's noise if given."""
    if noise is not None:
        turned = _NOISE / _POSITION * _ROTATION
        scale = torch.tensor([_NOISE] * 3 + [turned] * 6 + [0, 0])
        pose = pose + noise.randn(pose.shape).to(pose) * scale.to(pose)
    away = pose[:, :3]
    return torch.cat([away / _POSITION, away / (away.abs() + _NEAR), pose[:, 3:]], 1)


def gripper_plan(
    pose: Float[Tensor, "b 11"],
    tcp: Float[Tensor, "b o 7"],
    planned: Float[Tensor, "b h"],
    width: float,
    widths: tuple[float, ...],
) -> Float[Tensor, "b h"]:
    """Return the planned widths, as sight allows: `width` is kept until the hand rests at the next key pose.

    Then the gripper changes at the latest: the head alone, which sees the pose with noise, often does not
    plan to, even where recordings change within the plan more often than not.

    Args:
        pose: as from `true_pose`.
        tcp: of the observed ticks.
        widths: the two that are commanded.
    """
    away = pose[:, :3].norm(dim=1)[:, None]
    moved = (tcp[:, 1:, :3] - tcp[:, :-1, :3]).norm(dim=2)
    rests = (moved < _STILL).all(1, keepdim=True)
    planned = planned.where(rests & (away < _REACHED), width)
    after = torch.where(pose[:, 9:10] > 0.5, min(widths), max(widths))
    return torch.where(rests & (away < _AT), after, planned)


def face_any_way(
    pose: Float[Tensor, "b 11"], chunk: Float[Tensor, "b h 8"], noise: BatchNoise
) -> tuple[Float[Tensor, "b 11"], Float[Tensor, "b h 8"]]:
    """Return `true_pose` and plans ("body_twist") as where all faces another way about the hand's approach.

    Few recordings go the same way as seen from the hand; how they go does not depend on it.
    """
    axes = _about_z(2 * math.pi * noise.rand((len(pose), 1)).to(pose))
    x, y = pose[:, 3:_POSE].split(3, 1)
    rows = axes.mT @ torch.stack([x, y, torch.linalg.cross(x, y)], 1) @ axes
    place = pose[:, None, :3] @ axes
    there = torch.cat([place[:, 0], rows[:, :2].flatten(1), pose[:, _POSE:]], 1)
    turned = [chunk[..., :3] @ axes, chunk[..., 3:6] @ axes, chunk[..., 6:]]
    return there, torch.cat(turned, 2)


def set_beside(
    pose: Float[Tensor, "b 11"], chunk: Float[Tensor, "b h 8"], noise: BatchNoise
) -> tuple[Float[Tensor, "b 11"], Float[Tensor, "b h 8"]]:
    """Return half of the near key poses and plans ("body_twist") as from a hand beside the recorded one.

    The plans lead it back: recordings hardly show how errors are corrected. Where the gripper changes
    nothing is moved, so that it changes only in its place; and far away nothing need be corrected.
    """
    drawn = noise.randn((len(pose), 4)).to(pose) * torch.tensor(_BESIDE).to(pose)
    widths = chunk[..., -1]
    moved = (widths - widths[:, :1]).abs().amax(1) < _LEVELS
    moved &= pose[:, :3].norm(dim=1) < _CLOSE
    moved &= noise.rand((len(pose),)).to(pose) < 0.5
    shift, turn = (drawn * moved[:, None]).split([3, 1], 1)
    axes = _about_z(turn)
    there = torch.cat([pose[:, :3] + shift, pose[:, 3:_POSE]], 1).unflatten(1, (3, 3)) @ axes
    there = torch.cat([there.flatten(1), pose[:, _POSE:]], 1)
    back = (torch.arange(1, chunk.shape[1] + 1).to(chunk) / _BACK).clamp(max=1)[:, None]
    position = (chunk[..., :3] + back * shift[:, None]) @ axes
    rotation = chunk[..., 3:6] @ axes
    rotation = torch.cat([rotation[..., :2], rotation[..., 2:] + back * turn[:, None]], 2)
    return there, torch.cat([position, rotation, chunk[..., 6:]], 2)


def _about_z(turn: Float[Tensor, "b 1"]) -> Float[Tensor, "b 3 3"]:
    """Return matrices by which row vectors, times them, are turned about z (rad)."""
    cos, sin, zero = turn.cos(), turn.sin(), torch.zeros_like(turn)
    rows = torch.cat([cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1], 1)
    return rows.unflatten(1, (3, 3))

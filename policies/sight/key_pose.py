"""The next key pose: where the hand will be when the gripper next opens or closes, or the task ends.

Whether the gripper is closed afterwards is predicted with it, because the end of a task would otherwise be
taken for a place to grasp. Recordings provide both as labels (keyframes: James and Davison 2022). A policy
that is trained to predict them learns where objects are; one trained on the actions alone memorises the
recordings. The key pose after the next one is predicted too, because the hand and its object may hide it later.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.policies.sight.estimates import estimate_from, likeliest

KEY_POSE_DIM = 14  # of `features`
_POSE = 9  # position, and two columns of the rotation matrix
HOLD_SECONDS = 0.5  # s in which the fingers move
_LEVELS = 1e-3  # m between the least and the greatest commanded width: less is one width
_POSITION, _ROTATION = 0.05, 0.3  # m and rad that weigh the same
_NEAR = 0.02  # m; scale of the second input, which saturates above it
_NOISE = 0.003  # m (and as much of the rotation's columns) of noise on the input in training
_CLOSE = 0.1  # m from the key pose within which errors are corrected
_BESIDE = 0.02, 0.02, 0.01, 0.2  # m along the hand's axes, rad about its z axis
_BACK = 10  # ticks
_REACHED = 0.02  # m
_AT = math.sqrt(3) * _NOISE  # m; the training's noise, within which the head cannot see a distance
_STILL = 0.0002  # m per tick


def key_poses(
    tcp: Float32[np.ndarray, "n 7"],
    widths: Float32[np.ndarray, " n"],
    lengths: Sequence[int],
    hold: int,
) -> Float32[np.ndarray, "n 3 8"]:
    """Return for every tick the TCP pose at the last change of the commanded width and at the next two.

    Row 0 is the pose at the last change and 1, or the present pose and 0 before the first change. Row 1 is
    the pose at the next change, or at the end, and 1 if the gripper is closed after it, else 0. Row 2 is the
    same for the change after that. An episode that ends with an open gripper has released its object: then
    the last change stays the next one, because a hand above a placed object cannot be told from a hand
    above an object to grasp.

    Args:
        lengths: ticks of each episode, one after the other.
        hold: ticks for which a key pose stays the next one after the change: the change is not visible
            until the fingers have moved.
    """
    closed, changes = _closed(widths), gripper_changes(widths)
    ends = np.cumsum(lengths) - 1
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


def gripper_changes(widths: Float32[np.ndarray, " n"]) -> Int[np.ndarray, " c"]:
    """Return the ticks after which the gripper opens or closes, by its commanded widths (m)."""
    return (
        np.flatnonzero(np.diff(_closed(widths))) if np.ptp(widths) > _LEVELS else np.empty(0, int)
    )


def _closed(widths: Float32[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    return widths < (widths.min() + widths.max()) / 2


def true_pose(tcp: Float[Tensor, "b 7"], key: Float[Tensor, "b 3 8"]) -> Float[Tensor, "b 11"]:
    """Return the policy's input from true key poses: the next one in the hand's frame.

    It holds position (m), two columns of the rotation, 1 if the gripper is closed afterwards, and the
    `nearness` of the last change.
    """
    found = likeliest(estimate_from(tcp, key[:, 1, :7]))
    return torch.cat([found, key[:, 1, 7:], key[:, 0, 7:] * nearness(tcp, key[:, 0, :3])], 1)


def nearness(tcp: Float[Tensor, "b 7"], left: Float[Tensor, "b 3"]) -> Float[Tensor, "b 1"]:
    """Return how near the hand is to where the gripper last changed, from 1 (there) to 0 (far away).

    Near a grasp the hand must first rise: the straight way to the next key pose leads along the table.
    """
    away = (tcp[:, :3] - left).norm(dim=1, keepdim=True)
    return (-(away / _POSITION).square() / 2).exp()


def features(pose: Float[Tensor, "b 11"], noise: BatchNoise | None = None) -> Float[Tensor, "b 14"]:
    """Return the network input for a pose as from `true_pose`, with the training's noise if given."""
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
    """Return the planned widths, but keep `width` until the hand rests at the next key pose.

    There the gripper changes even if the head does not plan it: the head is trained with noise on the pose
    and often misses the change.

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
    """Rotate `true_pose` and plans ("body_twist") by a random angle about the hand's approach.

    Recordings cover few directions in the hand's frame, and the motion does not depend on the direction.
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
    """Displace the hand of half of the windows near a key pose; plans ("body_twist") lead it back.

    Recordings contain few corrections of errors. Windows in which the gripper changes are left as they
    are, so that it changes only at its place; so are those far away, which need no correction.
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
    """Return matrices that rotate row vectors about z by these angles (rad)."""
    cos, sin, zero = turn.cos(), turn.sin(), torch.zeros_like(turn)
    rows = torch.cat([cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1], 1)
    return rows.unflatten(1, (3, 3))

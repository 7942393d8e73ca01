"""The next key pose: where the hand will be when the gripper next opens or closes, or the task ends.

With it comes whether the gripper is closed afterwards: without that, the end of a task looks like the
place to grasp. The recordings hold both (keyframes: James and Davison 2022), and camera images show it. Taught it, a
policy learns where things are; trained on the actions alone, it memorises the recordings. The key pose
after it is predicted as well: later the hand and the object in it may hide that place.
"""

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float16, Float32
from torch import Tensor, nn

from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.policies.actions import Normalizer
from touchgoal.policies.heads.mlp import readout
from touchgoal.policies.perception.frozen_images import ImageInputConfig, ImageReadout
from touchgoal.policies.perception.proprioception import rotation_6d

KEY_POSE_DIM = 13  # of `features`
_POSE = 9  # position, and two columns of the rotation matrix
HOLD_SECONDS = 0.5  # s in which the fingers move
_LEVELS = 1e-3  # m between the least and the greatest commanded width: less is one width
_POSITION, _ROTATION = 0.05, 0.3  # m and rad that weigh alike
_SMALL = 0.1  # of these, below which an error counts squared
_NEAR = 0.02  # m; the second input grows fast below it, and hardly above
_NOISE = 0.003  # m and, of the rotation's columns, 1; on what the policy reads in training
_LEAST, _MOST = -5.0, 3.0  # logarithm of a camera's expected error
_BESIDE = 0.02, 0.02, 0.01, 0.2  # m along the hand's axes, rad about its z axis
_BACK = 10  # ticks
_REACHED = 0.02  # m
_AT = math.sqrt(3) * _NOISE  # m; the training's noise: the head cannot tell it from there
_STILL = 0.0002  # m per tick
_OPEN = 0.9  # of the range of widths, from the least
_MEMORY = 3.0  # s after which an estimate weighs 1/e in the average
_SEEN = 2  # key poses: the next one, and the one that follows
_GROUPS = 2, 1, 6  # of a pose: its place across the hand's approach, along it, and the rotation


def next_key_poses(
    tcp: Float32[np.ndarray, "n 7"],
    widths: Float32[np.ndarray, " n"],
    lengths: Sequence[int],
    hold: int,
) -> Float32[np.ndarray, "n 2 8"]:
    """Return for every tick the TCP pose at the next change of the commanded width, or at the end.

    And 1 if the gripper is closed after it, else 0; then the same of the change that follows. An episode
    that ends open has let go: then the last change stays, for the hand above what it left looks like the
    hand above what it will grasp.

    Args:
        lengths: ticks of each episode, one after the other.
        hold: ticks for which a key pose stays after the change: until the fingers have moved, nothing
            shows that it was commanded.
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
    return poses[np.searchsorted(until, np.arange(len(tcp)))]


def features(pose: Float[Tensor, "b 10"], noise: BatchNoise | None = None) -> Float[Tensor, "b 13"]:
    """Return a policy's input for the key poses in the hand's frame, with the training's noise if given."""
    if noise is not None:
        scale = torch.tensor([_NOISE] * 3 + [_NOISE / _POSITION * _ROTATION] * 6 + [0])
        pose = pose + noise.randn(pose.shape).to(pose) * scale.to(pose)
    away = pose[:, :3]
    return torch.cat([away / _POSITION, away / (away.abs() + _NEAR), pose[:, 3:]], 1)


def gripper_plan(
    pose: Float[Tensor, "b 10"],
    tcp: Float[Tensor, "b o 7"],
    planned: Float[Tensor, "b h"],
    width: float,
    widths: tuple[float, ...],
) -> Float[Tensor, "b h"]:
    """Return the planned widths, as sight allows: `width` is kept until the hand rests at the next key pose.

    Then the gripper changes at the latest: the head alone, which sees the pose with noise, often does not
    plan to, even where recordings change within the plan more often than not.

    Args:
        pose: of the next key pose in the hand's frame.
        tcp: of the observed ticks.
        widths: the two that are commanded.
    """
    away = pose[:, :3].norm(dim=1)[:, None]
    moved = (tcp[:, 1:, :3] - tcp[:, :-1, :3]).norm(dim=2)
    rests = (moved < _STILL).all(1, keepdim=True)
    planned = planned.where(rests & (away < _REACHED), width)
    after = torch.where(pose[:, 9:] > 0.5, min(widths), max(widths))
    return torch.where(rests & (away < _AT), after, planned)


def set_beside(
    pose: Float[Tensor, "b 10"], chunk: Float[Tensor, "b h 8"], noise: BatchNoise
) -> tuple[Float[Tensor, "b 10"], Float[Tensor, "b h 8"]]:
    """Return half of the key poses and plans ("body_twist") as from a hand beside the recorded one.

    The plans lead it back: recordings hardly show how errors are corrected. Where the gripper changes
    nothing is moved, so that it changes only in its place.
    """
    drawn = noise.randn((len(pose), 4)).to(pose) * torch.tensor(_BESIDE).to(pose)
    widths = chunk[..., -1]
    moved = (widths - widths[:, :1]).abs().amax(1) < _LEVELS
    moved &= noise.rand((len(pose),)).to(pose) < 0.5
    shift, turn = (drawn * moved[:, None]).split([3, 1], 1)
    cos, sin, zero = turn.cos(), turn.sin(), torch.zeros_like(turn)
    rows = torch.cat([cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1], 1)
    axes = rows.unflatten(1, (3, 3))  # R^T: row vectors times it are turned by `turn` about z
    there = torch.cat([pose[:, :3] + shift, pose[:, 3:_POSE]], 1).unflatten(1, (3, 3)) @ axes
    back = (torch.arange(1, chunk.shape[1] + 1).to(chunk) / _BACK).clamp(max=1)[:, None]
    position = (chunk[..., :3] + back * shift[:, None]) @ axes
    rotation = chunk[..., 3:6] @ axes
    rotation = torch.cat([rotation[..., :2], rotation[..., 2:] + back * turn[:, None]], 2)
    there = torch.cat([there.flatten(1), pose[:, _POSE:]], 1)
    return there, torch.cat([position, rotation, chunk[..., 6:]], 2)


class KeyPoseReadout(nn.Module):
    """Network from the cameras' feature maps to the next key pose relative to the hand, and the one after it.

    Each camera gives estimates and the errors that it expects: one on the hand in the hand's frame,
    another in the base's; and whether the gripper is closed after each. The estimates are averaged, the
    surer ones with more weight.
    """

    def __init__(self, config: ImageInputConfig) -> None:
        super().__init__()
        self.on_hand = config.on_hand
        self.images = nn.ModuleList(ImageReadout(config) for _ in config.cameras)
        self.height_normalizer, self.place_normalizer = Normalizer((1,)), Normalizer((3,))
        self.open_width = nn.Buffer(torch.zeros(1))  # m; at less the gripper is closed, or closes
        width, found = ImageReadout.width(config) + 2, _SEEN * (_POSE + len(_GROUPS) + 1)
        self.heads = nn.ModuleList(readout(width, 128, found) for _ in config.cameras)
        # added to the logarithms of the expected errors
        self.calibration = nn.Buffer(torch.zeros(len(config.cameras), _SEEN, len(_GROUPS)))

    def fit(
        self,
        maps: Float16[Tensor, "n k c y x"],
        tcp: Float[Tensor, "n 7"],
        width: Float[Tensor, "n 1"],
        key: Float[Tensor, "n 2 8"],
    ) -> None:
        """Fit the normalizers to training data."""
        for camera, images in enumerate(self.images):
            cast(ImageReadout, images).fit(maps[:, camera])
        self.height_normalizer.fit_mean_std(tcp[:, 2:3])
        self.open_width.copy_(width.amin() + _OPEN * (width.amax() - width.amin()))
        self.place_normalizer.fit_mean_std(key[..., :3].flatten(0, 1))

    @torch.no_grad()
    def calibrate(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
        key: Float[Tensor, "b 2 8"],
    ) -> None:
        """Scale the expected errors to those made on episodes that were not trained on.

        A network expects errors as small as those on what it has learned by heart (Guo et al. 2017).
        """
        poses, expected, _ = self._estimates(maps, tcp, width)
        made = _errors(poses, tcp, key) * (-expected).exp()
        self.calibration += made.mean(0).clamp(min=1e-3).log()

    def forward(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
    ) -> tuple[Float[Tensor, "b 2 10"], Float[Tensor, "b 2 3"]]:
        """Return the estimates in the hand's frame: position, m, and two columns of the rotation.

        Then the probability that the gripper is closed after it; and how much its place across the
        hand's approach, along it, and the rest weigh beside other estimates.
        """
        poses, expected, closed = self._estimates(maps, tcp, width)
        return _fused(poses, expected, closed), (-2 * expected).exp().sum(1)

    def loss(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
        key: Float[Tensor, "b 2 8"],
    ) -> tuple[Float[Tensor, ""], Float[Tensor, "b 10"]]:
        """Return the loss of the estimates and of the errors that the cameras expect, and the next key pose.

        The expected errors do not weigh the estimates (Seitzer et al. 2022): hard images are learned, too.
        No gradient goes through the estimate.
        """
        poses, expected, closed = self._estimates(maps, tcp, width)
        made = _errors(poses, tcp, key)
        errors = torch.stack([made[..., :2].norm(dim=-1), made[..., 2]], -1)
        errors = torch.where(errors < _SMALL, errors.square() / 2 / _SMALL, errors - _SMALL / 2)
        sureness = made.detach() * (-expected).exp() + expected
        after = F.binary_cross_entropy_with_logits(closed, key[:, None, :, 7].expand_as(closed))
        loss = errors.mean() + 0.1 * sureness.mean() + 0.1 * after
        return loss, _fused(poses, expected, closed)[:, 0].detach()

    def error(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
        key: Float[Tensor, "b 2 8"],
    ) -> Float[Tensor, "b 2"]:
        """Return how far the estimates are off, m."""
        off = self(maps, tcp, width)[0][..., :_POSE] - _in_hand_frame(tcp, _columns(key))
        return off[..., :3].norm(dim=-1)

    def _estimates(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
    ) -> tuple[Float[Tensor, "b k 2 9"], Float[Tensor, "b k 2 3"], Float[Tensor, "b k 2"]]:
        """Return each camera's poses in the hand's frame, and the logarithms of its expected errors.

        And the logits of the gripper's being closed after them.
        """
        height, is_open = self.height_normalizer(tcp[:, 2:3]), (width >= self.open_width).float()
        state = torch.cat([height, is_open], 1)  # the width itself depends on how an object is held
        poses, expected, closed = [], [], []
        for camera, (images, head) in enumerate(zip(self.images, self.heads, strict=True)):
            found = head(torch.cat([images(maps[:, camera]), state], 1)).unflatten(1, (_SEEN, -1))
            pose, error, after = found.split([_POSE, len(_GROUPS), 1], 2)
            if self.on_hand[camera]:
                pose = torch.cat([pose[..., :3] * _POSITION, pose[..., 3:]], 2)
            else:
                place = self.place_normalizer.inverse(pose[..., :3])
                pose = _in_hand_frame(tcp, torch.cat([place, pose[..., 3:]], 2))
            poses.append(pose)
            expected.append(error.clamp(_LEAST, _MOST) + self.calibration[camera])
            closed.append(after[..., 0])
        return torch.stack(poses, 1), torch.stack(expected, 1), torch.stack(closed, 1)


class KeyPoseAverage:
    """Average of an episode's estimates: over its goal the hand hides it from the cameras.

    Made in the base's frame. Once the gripper has changed, the key pose that followed is the next.
    """

    def __init__(self, plan_seconds: float) -> None:
        """Begin an episode with an estimate every `plan_seconds`."""
        self._keep = math.exp(-plan_seconds / _MEMORY)
        self._hold = math.ceil(HOLD_SECONDS / plan_seconds)
        self._moving = 0  # estimates still to come while the fingers move
        self._weight, self._mean = (
            torch.zeros(_SEEN, len(_GROUPS)),
            torch.zeros(1, _SEEN, _POSE + 1),
        )

    @property
    def gripper_moves(self) -> bool:
        """Return whether the gripper was commanded to change within `HOLD_SECONDS`."""
        return self._moving > 0

    def go_on(self) -> None:
        """Go on to the key pose that follows, once the fingers have moved: the gripper changes."""
        self._moving = self._hold

    def add(
        self,
        pose: Float[Tensor, "1 2 10"],
        weight: Float[Tensor, "1 2 3"],
        tcp: Float[Tensor, "1 7"],
    ) -> Float[Tensor, "1 10"]:
        """Add estimates in the hand's frame with their weights; return the next key pose, in that frame."""
        if not self.gripper_moves:
            before = self._weight * self._keep
            self._weight = before + weight[0]
            share = (weight[0] / self._weight).repeat_interleave(
                torch.tensor([*_GROUPS[:2], _GROUPS[2] + 1]), 1
            )
            self._mean = torch.lerp(self._mean, _in_base_frame(tcp, pose), share)
        found = _in_hand_frame(tcp, self._mean)[:, 0]
        if self._moving == 1:
            self._mean = self._mean[:, [1, 1]]
            self._weight = torch.stack([self._weight[1], torch.zeros(len(_GROUPS))])
        self._moving = max(self._moving - 1, 0)
        return found


def _errors(
    poses: Float[Tensor, "b k 2 9"], tcp: Float[Tensor, "b 7"], key: Float[Tensor, "b 2 8"]
) -> Float[Tensor, "b k 2 3"]:
    """Return how far poses in the hand's frame are off: across the hand's approach, along it, turned."""
    off = (poses - _in_hand_frame(tcp, _columns(key))[:, None]).split(_GROUPS, -1)
    scales = _POSITION, _POSITION, _ROTATION
    return torch.stack([x.norm(dim=-1) / scale for x, scale in zip(off, scales, strict=True)], -1)


def _fused(
    poses: Float[Tensor, "b k 2 9"],
    expected: Float[Tensor, "b k 2 3"],
    closed: Float[Tensor, "b k 2"],
) -> Float[Tensor, "b 2 10"]:
    weights = (-2 * expected).softmax(1)  # inverse squares of the expected errors
    weights = weights.repeat_interleave(torch.tensor(_GROUPS).to(poses.device), 3)
    return torch.cat([(weights * poses).sum(1), closed.mean(1).sigmoid()[..., None]], 2)


def _columns(key: Float[Tensor, "b n 8"]) -> Float[Tensor, "b n 9"]:
    """Return the poses of key poses, with two columns of the rotation in place of the quaternion."""
    columns = rotation_6d(key[..., 3:7].flatten(0, 1)).unflatten(0, key.shape[:2])
    return torch.cat([key[..., :3], columns], 2)


def _axes(tcp: Float[Tensor, "b 7"]) -> Float[Tensor, "b 1 3 3"]:
    """Return the hand's axes in the base's frame, as rows."""
    x, y = rotation_6d(tcp[:, 3:]).split(3, 1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], 1)[:, None]


def _in_hand_frame(
    tcp: Float[Tensor, "b 7"], pose: Float[Tensor, "b n p"]
) -> Float[Tensor, "b n p"]:
    """Return poses of the base frame (position, two columns of the rotation) in the hand's.

    What follows the pose stays.
    """
    rows = pose[..., :_POSE] - F.pad(tcp[:, None, :3], (0, 6))
    there = (rows.unflatten(2, (3, 3)) @ _axes(tcp).mT).flatten(2)
    return torch.cat([there, pose[..., _POSE:]], 2)


def _in_base_frame(
    tcp: Float[Tensor, "b 7"], pose: Float[Tensor, "b n p"]
) -> Float[Tensor, "b n p"]:
    """Return poses of the hand's frame in the base's; what follows them stays."""
    rows = (pose[..., :_POSE].unflatten(2, (3, 3)) @ _axes(tcp)).flatten(2)
    return torch.cat([rows + F.pad(tcp[:, None, :3], (0, 6)), pose[..., _POSE:]], 2)

"""Proprioception as a network reads it.

In the base frame: joints and TCP pose. Along the hand's own axes ("body_twist"): the hand's
velocity and the vertical, without place or heading, so that what is learned on one wire holds for
every wire that bends as much.

With `observation.command` among the columns the commanded arm stands in for the measured one:
delays and the arm's lag then do not change the input, and the policy does not repeat a correction.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.policies.actions import body_jacobian, tcp_poses
from touchgoal.policies.config import ActionRepresentation

_LENGTH_SCALE = 0.02  # m
# Columns along the hand's axes, and their `input_widths`.
_BODY_FRAME_WIDTHS = {ft.STATE: 7, ft.TCP_POSE: 3, ft.COMMAND: 0}


def tare(wrench: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the wrench (..., 6) less that of an episode's first tick, without contact.

    An arm's estimate has a bias of some newtons that lasts.
    """
    return (wrench - first).astype(np.float32)


def input_widths(columns: tuple[str, ...], kind: ActionRepresentation) -> list[int]:
    """Return the width of each column in `network_input`; KeyError for one unknown to "body_twist".

    The command has no width of its own: it replaces state and pose.
    """
    if kind == "body_twist":
        return [_BODY_FRAME_WIDTHS[key] for key in columns]
    more = {ft.TCP_POSE: 2, ft.TRUTH_START: 5, ft.COMMAND: -ft.FEATURES[ft.COMMAND].shape[0]}
    return [ft.FEATURES[key].shape[0] + more.get(key, 0) for key in columns]


def is_position(columns: tuple[str, ...], kind: ActionRepresentation) -> Float[Tensor, " r"]:
    """Return 1 for the joint and TCP positions in `network_input`, 0 for the rest."""
    marks = []
    for key, width in zip(columns, input_widths(columns, kind), strict=True):
        count = 0 if kind == "body_twist" else {ft.STATE: ft.N_JOINTS, ft.TCP_POSE: 3}.get(key, 0)
        marks += [1.0] * count + [0.0] * (width - count)
    return torch.tensor(marks)


def is_motion(columns: tuple[str, ...], kind: ActionRepresentation) -> Float[Tensor, " r"]:
    """Return 1 for velocities in `network_input`, 0 for the rest."""
    first, count = (0, 6) if kind == "body_twist" else (ft.N_JOINTS, ft.N_JOINTS)
    marks = torch.zeros(sum(input_widths(columns, kind)))  # the state comes first
    marks[first : first + count] = 1.0
    return marks


def network_input(
    state: Float[Tensor, "... s"], columns: tuple[str, ...], kind: ActionRepresentation
) -> Float[Tensor, "... r"]:
    """Return the network's input from columns of `features.FEATURES`, side by side.

    In the base frame the TCP's quaternion becomes the first two columns of its rotation matrix: a
    quaternion jumps to its negative as the hand turns, the matrix does not (Zhou et al. 2019).
    `truth.start` becomes relative to the hand, in axes parallel to the base's.

    Along the hand's axes the state becomes the TCP's linear and angular velocity (m/s, rad/s) and
    the gripper's width, the TCP's pose the vertical.
    """
    parts, start = {}, 0
    for key in columns:
        parts[key] = state[..., start : (start := start + ft.FEATURES[key].shape[0])]
    if ft.COMMAND in parts:  # it replaces measured joints, velocities and TCP
        command = parts.pop(ft.COMMAND)
        parts[ft.STATE] = torch.cat([command, parts[ft.STATE][..., -1:]], -1)
        if ft.TCP_POSE in parts:
            parts[ft.TCP_POSE] = tcp_poses(command[..., : ft.N_JOINTS])
    if kind == "body_twist":
        joints, velocity, width = parts[ft.STATE].split([ft.N_JOINTS, ft.N_JOINTS, 1], -1)
        twist = (body_jacobian(joints) @ velocity[..., None])[..., 0]
        parts[ft.STATE] = torch.cat([twist, width], -1)
        if ft.TCP_POSE in parts:
            parts[ft.TCP_POSE] = _vertical_in_body_frame(parts[ft.TCP_POSE][..., 3:])
    elif ft.TCP_POSE in parts:
        pose = parts[ft.TCP_POSE]
        turned = rotation_6d(pose[..., 3:])
        if ft.TRUTH_START in parts:
            held = parts[ft.TRUTH_CONTACT].amin(-1, keepdim=True)
            parts[ft.TRUTH_START] = _start_from_hand(
                parts[ft.TRUTH_START], pose[..., :3], turned, held
            )
        parts[ft.TCP_POSE] = torch.cat([pose[..., :3], turned], -1)
    return torch.cat([parts[key] for key in columns if key in parts], -1)


def _vertical_in_body_frame(quaternion: Float[Tensor, "... 4"]) -> Float[Tensor, "... 3"]:
    """Return the base's z axis in the frame that the quaternion rotates."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1)


def _start_from_hand(
    start: Float[Tensor, "... 7"],
    hand: Float[Tensor, "... 3"],
    turned: Float[Tensor, "... 6"],
    held: Float[Tensor, "... 1"],
) -> Float[Tensor, "... 12"]:
    """Return `features.TRUTH_START` relative to the hand's position and yaw."""
    cos, sin = turned[..., 0], turned[..., 1]
    cos, sin = cos * cos - sin * sin, 2 * cos * sin  # cosine and sine of twice the hand's yaw
    yaw = torch.stack(
        [start[..., 3] * cos + start[..., 4] * sin, start[..., 4] * cos - start[..., 3] * sin], -1
    )
    there, height = (start[..., :2] - hand[..., :2]) * (1 - held), start[..., 2:3] - hand[..., 2:]
    goal, yaw = (start[..., 5:] - hand[..., :2]) * held, yaw * (1 - held)
    way = torch.cat([there, height, goal], -1)
    return torch.cat([way, yaw, way / (way.abs() + _LENGTH_SCALE)], -1)


def rotation_6d(quaternion: Float[Tensor, "... 4"]) -> Float[Tensor, "... 6"]:
    """Return the first two columns of the rotation matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = quaternion.unbind(-1)
    columns = [
        1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
        2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
    ]  # fmt: skip
    return torch.stack(columns, -1)

"""Where an arm's tool centre point is and how its joints move it, compiled: the twin asks several
times a millisecond."""

from typing import no_type_check

import mujoco
import numpy as np
from jaxtyping import Float
from numba import njit

Vector3 = Float[np.ndarray, "3"]
Matrix3 = Float[np.ndarray, "3 3"]


class SerialArm:
    """The chain of turning joints that carries a model's `tcp` site."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Read the chain from a model, whose world frame is the base frame."""
        site = model.site("tcp")
        p, R = tool = site.pos.copy(), _matrix(site.quat)
        links = []
        body = int(model.site_bodyid[site.id])
        while body:
            turned, joint = _matrix(model.body_quat[body]), int(model.body_jntadr[body])
            if joint >= 0:
                links.append((model.body_pos[body], turned, model.jnt_axis[joint]))
                if len(links) == 1:
                    tool = p, R
                p, R = np.zeros(3), np.eye(3)
            elif links:  # a fixed link below a joint's
                offset, after, axis = links[-1]
                moved = model.body_pos[body] + turned @ offset
                links[-1] = moved, turned @ after, axis
            else:
                p, R = model.body_pos[body] + turned @ p, turned @ R
            body = int(model.body_parentid[body])
        offsets, rotations, axes = (np.array(part) for part in zip(*links[::-1], strict=True))
        self._offsets, self._rotations, self._axes, self._tool = offsets, rotations, axes, tool

    def pose_and_jacobian(
        self, q: Float[np.ndarray, " n"], offset: Vector3
    ) -> tuple[Vector3, Matrix3, Float[np.ndarray, "6 n"]]:
        """Position (m), rotation and geometric Jacobian, base frame, of a point on the tool.

        Args:
            q: joint positions, rad.
            offset: of the point from the TCP, in its frame, m.
        """
        return _pose_and_jacobian(
            self._offsets, self._rotations, self._axes, *self._tool, q, offset
        )


def _matrix(quaternion: Float[np.ndarray, "4"]) -> Matrix3:
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, quaternion)
    return R.reshape(3, 3)


@njit(cache=True)
@no_type_check
def _pose_and_jacobian(offsets, rotations, axes, tool_offset, tool_rotation, q, offset):
    n = len(q)
    origins, turned = np.empty((n, 3)), np.empty((n, 3))
    p, R, turn = np.zeros(3), np.eye(3), np.empty((3, 3))
    for i in range(n):
        p = p + _times(R, offsets[i])
        R = _product(R, rotations[i])
        origins[i], turned[i] = p, _times(R, axes[i])
        x, y, z = axes[i]
        c, s = np.cos(q[i]), np.sin(q[i])
        turn[0] = c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s
        turn[1] = y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s
        turn[2] = z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)
        R = _product(R, turn)
    p = p + _times(R, tool_offset)
    R = _product(R, tool_rotation)
    p = p + _times(R, offset)
    jacobian = np.empty((6, n))
    for i in range(n):
        a, d = turned[i], p - origins[i]
        jacobian[0, i] = a[1] * d[2] - a[2] * d[1]
        jacobian[1, i] = a[2] * d[0] - a[0] * d[2]
        jacobian[2, i] = a[0] * d[1] - a[1] * d[0]
        jacobian[3:, i] = a
    return p, R, jacobian


@njit(inline="always")
@no_type_check
def _times(R, v):
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@njit(inline="always")
@no_type_check
def _product(A, B):
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return out

"""Rotations as vectors and matrices, and those of a hand with its fingers down."""

import cv2
import numpy as np
from jaxtyping import Float

Vector3 = Float[np.ndarray, "3"]
Matrix3 = Float[np.ndarray, "3 3"]


def rotation_vector(R: Matrix3) -> Vector3:
    """Return axis times angle (rad) of a rotation matrix.

    cv2.Rodrigues returns 0 for turns below 1e-5 rad, which at 1 kHz are 0.01 rad/s; scipy's is slower.
    """
    cosine = np.clip((np.trace(R) - 1) / 2, -1.0, 1.0)
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = np.linalg.norm(skew)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-9:
        return skew * (angle / sine)
    if cosine > 0:
        return skew
    axis = np.sqrt(np.maximum((np.diag(R) + 1) / 2, 0))  # half a turn: R = 2 a a^T - 1
    k = int(np.argmax(axis))
    return angle * (R[:, k] + np.eye(3)[k]) / (2 * axis[k])


def rotation_matrix(vector: Vector3) -> Matrix3:
    """Return the rotation about `vector` by its length (rad)."""
    return cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0]


def fingers_down(yaw: float) -> Matrix3:
    """Return the TCP rotation in the base frame: approach down, turned by `yaw` about base z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def fingers_across(direction: Vector3) -> Matrix3:
    """Return the TCP rotation, base frame: x along a direction, approach as steep as possible.

    The fingers then close across the direction, which must not be vertical.
    """
    x = direction / np.linalg.norm(direction)
    z = np.array([0.0, 0.0, -1.0]) + x[2] * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)

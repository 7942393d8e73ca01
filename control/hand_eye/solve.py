"""Hand-eye calibration: a camera's pose and lens from views of a board and the arm's poses.

A first estimate by the closed form of Park and Martin ("Robot sensor calibration: solving AX = XB on the
Euclidean group", IEEE Transactions on Robotics and Automation 10(5), 1994; OpenCV 5 has no
calibrateHandEye) is refined by least squares on the reprojection error. That also uses the arm's
motion to measure the lens. Transforms are 4 x 4, `T_a_b` maps points of b to a; the camera's frame is OpenCV's: x
right, y down, z ahead.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from touchgoal.control.hand_eye.board import BoardView
from touchgoal.control.motion.rotations import rotation_matrix, rotation_vector
from touchgoal.runtime.errors import UserError

Transform = Float[np.ndarray, "4 4"]
MIN_VIEWS = 6
_MOST_UNSURE = 0.01, np.radians(1.0)  # m, rad of standard error beyond which a result is refused
_TOO_ALIKE = (
    "the views do not fix the camera: turn the board or the hand by 20 degrees and more about two axes, and "
    "change the distance"
)


@dataclass(frozen=True)
class Lens:
    """A pinhole camera with radial distortion (OpenCV's k1, k2)."""

    fx: float  # focal lengths, px
    fy: float
    cx: float  # principal point, px
    cy: float
    k1: float
    k2: float

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def distortion(self) -> Float[np.ndarray, "5"]:
        """OpenCV's coefficients."""
        return np.array([self.k1, self.k2, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class HandEye:
    """Result of a calibration."""

    pose: Transform  # of the camera: in the hand's frame (wrist) or the base's (front)
    lens: Lens
    pixel_error: float  # root mean square reprojection error, px
    # Difference between where each view and where the arm and the calibration place the board.
    position_errors: Float[np.ndarray, " n"]  # m
    rotation_errors: Float[np.ndarray, " n"]  # rad
    # Standard errors of the pose, if pixel errors are independent.
    position_error: float  # m
    rotation_error: float  # rad


def calibrate_hand_eye(
    views: Sequence[BoardView],
    hand_poses: Sequence[Transform],
    image_size: tuple[int, int],
    on_hand: bool,
) -> HandEye:
    """Calibrate a camera on the hand that sees a resting board, or one at rest that sees a board in the hand.

    UserError: too few views, or views that do not fix the camera.

    Args:
        views: Corners seen in each view.
        hand_poses: Pose of the hand in the base frame for each view.
        image_size: Width and height, px.
    """
    if len(views) < MIN_VIEWS:
        raise UserError(f"{len(views)} views show the board, {MIN_VIEWS} are needed, 15 are good")
    # The camera sees the board at inv(X) M Y: X the camera's pose, Y the board's in the other frame.
    motions = [_inverse(pose) if on_hand else pose for pose in hand_poses]
    lens, seen = _calibrate_lens(views, image_size)
    camera = _park_martin(motions, seen)
    board = _inverse(motions[0]) @ camera @ seen[0]

    def split(parameters: np.ndarray) -> tuple[Lens, Transform, Transform]:
        own = Lens(*(float(value) for value in parameters[:6] * scale))
        return own, camera @ _transform(parameters[6:12]), board @ _transform(parameters[12:])

    def residuals(parameters: np.ndarray) -> np.ndarray:
        own, X, Y = split(parameters)
        back = _inverse(X)
        return np.concatenate(
            [
                (_project(view.points, back @ M @ Y, own) - view.pixels).ravel()
                for view, M in zip(views, motions, strict=True)
            ]
        )

    scale = np.array([lens.fx, lens.fy, lens.fx, lens.fy, 1.0, 1.0])
    start = np.array([lens.fx, lens.fy, lens.cx, lens.cy, lens.k1, lens.k2]) / scale
    fit = least_squares(residuals, np.concatenate([start, np.zeros(12)]), x_scale="jac")
    lens, camera_pose, board_pose = split(fit.x)
    position, rotation = _standard_errors(fit.jac, fit.fun)
    seen = [_board_pose(view, lens) for view in views]
    expected = [_inverse(camera_pose) @ M @ board_pose for M in motions]
    off = [_inverse(a) @ b for a, b in zip(expected, seen, strict=True)]
    return HandEye(
        pose=camera_pose,
        lens=lens,
        pixel_error=float(np.sqrt(2 * np.mean(fit.fun**2))),
        position_errors=np.array([np.linalg.norm(T[:3, 3]) for T in off]),
        rotation_errors=np.array([np.linalg.norm(rotation_vector(T[:3, :3])) for T in off]),
        position_error=position,
        rotation_error=rotation,
    )


def _calibrate_lens(
    views: Sequence[BoardView], image_size: tuple[int, int]
) -> tuple[Lens, list[Transform]]:
    """Return the lens and the board's pose in each view by Zhang's method, without the arm."""
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    _, K, distortion, turns, shifts = cv2.calibrateCamera(
        points, pixels, image_size, None, None, flags=flags
    )  # pyright: ignore[reportCallIssue, reportArgumentType]
    k1, k2 = np.ravel(distortion)[:2]
    lens = Lens(*(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2)))
    return lens, [_transform(np.append(r, t)) for r, t in zip(turns, shifts, strict=True)]


def _park_martin(motions: Sequence[Transform], seen: Sequence[Transform]) -> Transform:
    """Return X of A X = X B for all pairs of views."""
    A, B = (
        [first @ _inverse(second) for first, second in combinations(poses, 2)]
        for poses in (motions, seen)
    )
    a, b = (np.array([rotation_vector(T[:3, :3]) for T in pairs]) for pairs in (A, B))
    U, S, Vt = np.linalg.svd(a.T @ b)
    if S[1] < 1e-3 * S[0]:  # turned about one axis alone
        raise UserError(_TOO_ALIKE)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    rows = np.concatenate([T[:3, :3] - np.eye(3) for T in A])
    shifts = np.concatenate([R @ Tb[:3, 3] - Ta[:3, 3] for Ta, Tb in zip(A, B, strict=True)])
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, np.linalg.lstsq(rows, shifts, rcond=None)[0]
    return X


def _standard_errors(
    jacobian: Float[np.ndarray, "m p"], residuals: Float[np.ndarray, " m"]
) -> tuple[float, float]:
    """Return the standard errors of the camera's position (m) and orientation (rad); UserError if large."""
    variance = residuals @ residuals / (residuals.size - jacobian.shape[1])
    try:
        covariance = variance * np.linalg.inv(jacobian.T @ jacobian)
    except np.linalg.LinAlgError as error:
        raise UserError(_TOO_ALIKE) from error
    spread = np.sqrt(np.abs(np.diag(covariance)[6:12]))
    position, rotation = float(np.linalg.norm(spread[3:])), float(np.linalg.norm(spread[:3]))
    if position > _MOST_UNSURE[0] or rotation > _MOST_UNSURE[1]:
        raise UserError(_TOO_ALIKE)
    return position, rotation


def _board_pose(view: BoardView, lens: Lens) -> Transform:
    _, turn, shift = cv2.solvePnP(view.points, view.pixels, lens.matrix, lens.distortion)
    return _transform(np.append(turn, shift))


def _project(
    points: Float[np.ndarray, "k 3"], T_camera_board: Transform, lens: Lens
) -> Float[np.ndarray, "k 2"]:
    x, y, z = (points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]).T
    x, y = x / z, y / z
    r2 = x * x + y * y
    stretch = 1 + r2 * (lens.k1 + lens.k2 * r2)
    return np.stack([lens.fx * stretch * x + lens.cx, lens.fy * stretch * y + lens.cy], axis=1)


def _transform(change: Float[np.ndarray, "6"]) -> Transform:
    """Return the transform of a rotation vector (rad), then a shift (m)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(change[:3]), change[3:]
    return T


def _inverse(T: Transform) -> Transform:
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return back

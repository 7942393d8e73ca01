"""Hand-eye calibration: a camera's pose and lens from views of a board and the arm's poses.

Zhang's method gives the lens, the closed form of Park and Martin the pose ("Robot sensor calibration:
solving AX = XB on the Euclidean group", IEEE Transactions on Robotics and Automation 10(5), 1994;
OpenCV 5 has no calibrateHandEye); `bundle.py` refines both. Each view is left out in turn: by how much
the others miss it, and by how much the result changes (jackknife), say how far to trust the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float

from touchgoal.control.hand_eye.board import BoardView
from touchgoal.control.hand_eye.bundle import (
    Bundle,
    Estimate,
    Lens,
    Transform,
    inverse,
    transform,
)
from touchgoal.control.motion.rotations import rotation_vector
from touchgoal.runtime.errors import UserError

MIN_VIEWS = 6
_MOST_UNSURE = 0.01, np.radians(1.0)  # m, rad of standard error beyond which a result is refused
_MOST_OFF = 0.01  # m by which the others may miss a view
_SQUARE_OFF = 0.01  # share by which squares may differ from what is given
_LEAST_NOISE = 0.05  # px, of a corner
_TOO_ALIKE = (
    "the views do not fix the camera: turn the board or the hand by 20 degrees and more about two axes, and "
    "change the distance"
)


@dataclass(frozen=True)
class HandEye:
    """Result of a calibration."""

    pose: Transform  # of the camera: in the hand's frame (wrist) or the base's (front)
    lens: Lens
    pixel_error: float  # root mean square reprojection error, px
    arm_noise: float  # m by which the hand's position is off in a view, on each axis
    # Difference between where each view and where the arm and the other views place the board.
    position_errors: Float[np.ndarray, " n"]  # m, in its middle
    rotation_errors: Float[np.ndarray, " n"]  # rad
    # Standard errors of the pose, by jackknife over views.
    position_error: float  # m
    rotation_error: float  # rad
    square_scale: float  # side of the board's squares by the views, over the given one
    square_scale_error: float  # its standard error
    closed_form: Transform  # the pose by Park and Martin's method


def calibrate_hand_eye(
    views: Sequence[BoardView],
    hand_poses: Sequence[Transform],
    image_size: tuple[int, int],
    on_hand: bool,
) -> HandEye:
    """Calibrate a camera on the hand that sees a resting board, or one at rest that sees a board in the hand.

    UserError: too few views, views that do not fix the camera, squares other than the given ones, or a
    view that contradicts the others.

    Args:
        views: Corners seen in each view.
        hand_poses: Pose of the hand in the base frame for each view.
        image_size: Width and height, px.
    """
    if len(views) < MIN_VIEWS:
        raise UserError(f"{len(views)} views show the board, {MIN_VIEWS} are needed, 15 are good")
    lens, seen, noise = _calibrate_lens(views, image_size)
    # The camera sees the board at inv(X) M Y: X the camera's pose, Y the board's in the other frame.
    motions = [inverse(pose) if on_hand else pose for pose in hand_poses]
    camera = _park_martin(motions, seen)
    start = Estimate(lens, camera, inverse(motions[0]) @ camera @ seen[0])
    try:
        best, without, pixel_error, arm_noise = Bundle(
            views, hand_poses, on_hand, start, noise
        ).fit()
    except np.linalg.LinAlgError as error:
        raise UserError(_TOO_ALIKE) from error
    turns, shifts = _differences([inverse(best.camera) @ other.camera for other in without])
    missed = zip(views, hand_poses, without, strict=True)
    off = [_missed(view, other.board_seen(hand, on_hand), other) for view, hand, other in missed]
    rotation_errors, position_errors = (np.linalg.norm(part, axis=1) for part in _differences(off))
    result = HandEye(
        pose=best.camera,
        lens=best.lens,
        pixel_error=pixel_error,
        arm_noise=arm_noise,
        position_errors=position_errors,
        rotation_errors=rotation_errors,
        position_error=_jackknife(shifts),
        rotation_error=_jackknife(turns),
        square_scale=best.scale,
        square_scale_error=_jackknife(np.array([[other.scale] for other in without])),
        closed_form=camera,
    )
    _require_sound(result)
    return result


def _require_sound(result: HandEye) -> None:
    """Raise UserError for a result that the views do not bear out."""
    if result.position_error > _MOST_UNSURE[0] or result.rotation_error > _MOST_UNSURE[1]:
        raise UserError(_TOO_ALIKE)
    scale, error = result.square_scale, result.square_scale_error
    if abs(scale - 1) > max(_SQUARE_OFF, 3 * error):
        raise UserError(
            f"the views show squares of {scale:.3f} times the given side (standard error {error:.3f}): "
            "measure the printed board over all its squares and correct --square-mm"
        )
    worst, mm = int(result.position_errors.argmax()), 1e3 * result.position_errors
    if mm[worst] > 1e3 * _MOST_OFF:
        raise UserError(
            f"view {worst + 1} is {mm[worst]:.0f} mm from where the others place the board "
            f"({mm.mean():.1f} mm on average): fix board and camera, hold the arm still, and take the "
            "views anew"
        )


def _calibrate_lens(
    views: Sequence[BoardView], image_size: tuple[int, int]
) -> tuple[Lens, list[Transform], float]:
    """Return lens, board poses and pixel noise (px on each axis) by Zhang's method, without the arm."""
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    distance, K, distortion, turns, shifts = cv2.calibrateCamera(
        points, pixels, image_size, None, None, flags=flags
    )  # pyright: ignore[reportCallIssue, reportArgumentType]
    k1, k2 = np.ravel(distortion)[:2]
    lens = Lens(*(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2)))
    seen = [transform(np.append(r, t)) for r, t in zip(turns, shifts, strict=True)]
    return lens, seen, max(_LEAST_NOISE, float(distance) / np.sqrt(2))


def _park_martin(motions: Sequence[Transform], seen: Sequence[Transform]) -> Transform:
    """Return X of A X = X B for all pairs of views."""
    A, B = (
        [first @ inverse(second) for first, second in combinations(poses, 2)]
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


def _missed(view: BoardView, expected: Transform, estimate: Estimate) -> Transform:
    """Return the board's pose in a view, in the frame of the expected one's middle."""
    middle = np.eye(4)
    middle[:3, 3] = estimate.scale * view.points.mean(axis=0)
    points = estimate.scale * view.points - middle[:3, 3]
    lens = estimate.lens
    _, turn, shift = cv2.solvePnP(points, view.pixels, lens.matrix, lens.distortion)
    return inverse(expected @ middle) @ transform(np.append(turn, shift))


def _differences(
    changes: Sequence[Transform],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return rotation vectors (rad) and shifts (m) of transforms."""
    turns = [rotation_vector(T[:3, :3]) for T in changes]
    return np.array(turns), np.array([T[:3, 3] for T in changes])


def _jackknife(without: Float[np.ndarray, "n d"]) -> float:
    """Return the standard error of a vector by its values without each view."""
    return float(np.sqrt((len(without) - 1) * np.var(without, axis=0).sum()))

"""Hand-eye calibration: a camera's pose and lens from views of a board and the arm's poses.

Zhang's method gives the lens, the closed form of Park and Martin the pose ("Robot sensor calibration:
solving AX = XB on the Euclidean group", IEEE Transactions on Robotics and Automation 10(5), 1994;
OpenCV 5 has no calibrateHandEye). A bundle adjustment refines both, with the squares' size and with an
error of the hand in each view, which would go into the lens otherwise. Each view is left out in turn:
by how much the others miss it, and by how much the result changes (jackknife), say how far to trust
it. Transforms are 4 x 4, `T_a_b` maps points of b to a; the camera's frame is OpenCV's: x right, y
down, z ahead.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import partial
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from touchgoal.control.arrays import Image
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.hand_eye.board import Board, BoardView
from touchgoal.control.interfaces import Joints
from touchgoal.control.motion.arm_models import ArmModel
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.rotations import rotation_matrix, rotation_vector
from touchgoal.runtime.errors import UserError

Transform = Float[np.ndarray, "4 4"]
MIN_VIEWS = 6
_MOST_UNSURE = 0.01, np.radians(1.0)  # m, rad of standard error beyond which a result is refused
_MOST_OFF = 0.01  # m by which the others may miss a view
_SQUARE_OFF = 0.01  # share by which squares may differ from what is given
_LEAST_NOISE = 0.05  # px, of a corner
# Standard deviation of the hand's error on each axis, rad and m, to begin with: the views correct its
# size, but not below this share, an arm's repeatability.
_ARM_NOISE, _LEAST_SHARE, _ROUNDS = np.array([np.radians(0.1)] * 3 + [5e-4] * 3), 0.1, 2
_SHARED = 19  # parameters that all views share: lens, camera, board, squares
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
    def opencv(self) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "5"]]:
        """OpenCV's camera matrix and distortion coefficients."""
        matrix = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
        return matrix, np.array([self.k1, self.k2, 0.0, 0.0, 0.0])


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
    # The camera sees the board at inv(X) M Y: X the camera's pose, Y the board's in the other frame.
    motions = np.linalg.inv(hand_poses) if on_hand else np.array(hand_poses)
    lens, seen, noise = _calibrate_lens(views, image_size)
    camera = _park_martin(motions, seen)
    start = _Estimate(lens, camera, np.linalg.inv(motions[0]) @ camera @ seen[0], 1.0)
    try:
        best, without, pixel_error, arm_noise = _adjust(views, motions, on_hand, start, noise)
    except np.linalg.LinAlgError as error:
        raise UserError(_TOO_ALIKE) from error
    change = np.array([_vector(np.linalg.inv(best.camera) @ other.camera) for other in without])
    missed = zip(views, motions, without, strict=True)
    off = np.array([_missed(view, other.board_seen(M), other) for view, M, other in missed])
    result = HandEye(
        pose=best.camera,
        lens=best.lens,
        pixel_error=pixel_error,
        arm_noise=arm_noise,
        position_errors=np.linalg.norm(off[:, 3:], axis=1),
        rotation_errors=np.linalg.norm(off[:, :3], axis=1),
        position_error=_jackknife(change[:, 3:]),
        rotation_error=_jackknife(change[:, :3]),
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
    seen = [_transform(np.append(r, t)) for r, t in zip(turns, shifts, strict=True)]
    return lens, seen, max(_LEAST_NOISE, float(distance) / np.sqrt(2))


def _park_martin(motions: Float[np.ndarray, "n 4 4"], seen: Sequence[Transform]) -> Transform:
    """Return X of A X = X B for all pairs of views."""
    A, B = (
        [first @ np.linalg.inv(second) for first, second in combinations(poses, 2)]
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


@dataclass(frozen=True)
class _Estimate:
    lens: Lens
    camera: Transform
    board: Transform
    scale: float  # true side of the board's squares over the given one

    def moved(self, change: Float[np.ndarray, " p"]) -> "_Estimate":
        own = self.lens
        lens = np.array(astuple(own)) + change[:6] * [own.fx, own.fy, own.fx, own.fy, 1.0, 1.0]
        camera = self.camera @ _transform(change[6:12])
        board = self.board @ _transform(change[12:18])
        scale = self.scale * float(np.exp(change[18]))
        return _Estimate(Lens(*lens.tolist()), camera, board, scale)

    def board_seen(self, motions: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
        return np.linalg.inv(self.camera) @ motions @ self.board


def _adjust(
    views: Sequence[BoardView],
    motions: Float[np.ndarray, "n 4 4"],
    on_hand: bool,
    start: _Estimate,
    noise: float,
) -> tuple[_Estimate, list[_Estimate], float, float]:
    """Return the best estimate, that without each view, reprojection error (rms, px) and arm noise (m).

    Without a view: one step of Newton's method from the whole. LinAlgError: the views do not fix it.
    """
    owner = np.repeat(np.arange(len(views)), [len(view.points) for view in views])
    points = np.concatenate([view.points for view in views])
    pixels = np.concatenate([view.pixels for view in views])

    def residuals(parameters: np.ndarray, share: float) -> np.ndarray:
        """Return errors of pixels, then of the hand, in standard deviations."""
        now, errors = start.moved(parameters), parameters[_SHARED:].reshape(-1, 6)
        turns, shifts = np.split(share * _ARM_NOISE * errors, 2, axis=1)
        moves = np.tile(np.eye(4), (len(views), 1, 1))
        moves[:, :3, :3], moves[:, :3, 3] = Rotation.from_rotvec(turns).as_matrix(), shifts
        poses = now.board_seen(moves @ motions if on_hand else motions @ moves)[owner]
        seen = np.einsum("kij,kj->ki", poses[:, :3, :3], now.scale * points) + poses[:, :3, 3]
        projected = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), *now.lens.opencv)[0]
        return np.append((projected[:, 0] - pixels) / noise, errors)

    solve = partial(least_squares, residuals, x_scale="jac", method="lm")
    share, fit = 1.0, solve(np.zeros(_SHARED + 6 * len(views)), args=(1.0,))
    for _ in range(_ROUNDS):  # MacKay's update of a prior's variance
        errors, covariance = fit.x[_SHARED:], np.linalg.inv(fit.jac.T @ fit.jac)
        determined = errors.size - np.trace(covariance[_SHARED:, _SHARED:])
        factor = max(float(np.sqrt(errors @ errors / determined)), _LEAST_SHARE / share)
        share *= factor
        fit = solve(np.append(fit.x[:_SHARED], errors / factor), args=(share,))
    H = fit.jac.T @ fit.jac
    without = []
    for i in range(len(views)):
        rows = np.flatnonzero(np.repeat(owner, 2) == i)
        J = fit.jac[rows]
        without.append(start.moved(fit.x + np.linalg.solve(H - J.T @ J, J.T @ fit.fun[rows])))
    pixel_error = noise * np.sqrt(2 * np.mean(fit.fun[: pixels.size] ** 2))
    return start.moved(fit.x), without, float(pixel_error), share * float(_ARM_NOISE[-1])


def _missed(view: BoardView, expected: Transform, estimate: _Estimate) -> Float[np.ndarray, "6"]:
    """Return turn (rad) and shift (m) of the board in a view from its expected pose, about its middle."""
    middle = np.eye(4)
    middle[:3, 3] = estimate.scale * view.points.mean(axis=0)
    points = estimate.scale * view.points - middle[:3, 3]
    _, turn, shift = cv2.solvePnP(points, view.pixels, *estimate.lens.opencv)
    return _vector(np.linalg.inv(expected @ middle) @ _transform(np.append(turn, shift)))


def _jackknife(without: Float[np.ndarray, "n d"]) -> float:
    """Return the standard error of a vector by its values without each view."""
    return float(np.sqrt((len(without) - 1) * np.var(without, axis=0).sum()))


def _transform(change: Float[np.ndarray, "6"]) -> Transform:
    """Return the transform of a rotation vector (rad), then a shift (m)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(change[:3]), change[3:]
    return T


def _vector(T: Transform) -> Float[np.ndarray, "6"]:
    """Return the inverse of `_transform`."""
    return np.append(rotation_vector(T[:3, :3]), T[:3, 3])


_SETTLING = 0.5  # s after which an arm swings no more and images are newer than its motion
_REST = 0.01  # rad/s


@dataclass(frozen=True)
class View:
    """An image, the arm's measured joint positions (rad) in it, and the board if it is seen."""

    image: Image
    q: Joints
    board: BoardView | None


def take_view(connection: CellConnection, camera: str, board: Board) -> View:
    """Take a view by the connection's camera of that key; UserError if the arm moves."""
    clock = connection.clock
    clock.wait(clock.now() + _SETTLING)
    reading = connection.arm.read()
    image = connection.cameras[camera].read().image
    if np.abs(reading.velocity).max() > _REST:
        raise UserError("the arm moves: hold it still for a view")
    return View(image, reading.q, board.find(image))


def calibrate_camera(views: list[View], arm: ArmModel, on_hand: bool) -> HandEye:
    """Calibrate from the views that show the board; see `calibrate_hand_eye`."""
    kinematics = Kinematics(arm, 0.0)
    seen = [(view.board, _pose(kinematics, view.q)) for view in views if view.board is not None]
    rows, columns = views[0].image.shape[:2] if views else (0, 0)
    boards, poses = [board for board, _ in seen], [pose for _, pose in seen]
    return calibrate_hand_eye(boards, poses, (columns, rows), on_hand)


def _pose(kinematics: Kinematics, q: Joints) -> Transform:
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = kinematics.forward(q)
    return T

"""Bundle adjustment: a camera's pose and lens, the board's pose and squares, and the arm's errors together.

An arm is not exactly where its joints say. So the hand has an error of its own in each view, and
pixels and arm are weighed by their noise; else the arm's errors would go into the lens. Transforms are
4 x 4, `T_a_b` maps points of b to a; the camera's frame is OpenCV's: x right, y down, z ahead.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from touchgoal.control.hand_eye.board import BoardView
from touchgoal.control.motion.rotations import rotation_matrix

Transform = Float[np.ndarray, "4 4"]
# Standard deviation of the hand's error in a view on each axis, rad and m; the views correct its
# size, down to what is an arm's repeatability.
_ARM_NOISE = np.array([np.radians(0.1)] * 3 + [5e-4] * 3)
_LEAST_SHARE, _ROUNDS = 0.1, 2
_SHARED = 19  # parameters that all views share
_STEP = 1e-6  # for derivatives


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
class Estimate:
    """Poses of a camera on the hand and of a board in the base's frame, or the other way round."""

    lens: Lens
    camera: Transform
    board: Transform
    scale: float = 1.0  # true side of the board's squares over the given one

    def board_seen(
        self, hands: Float[np.ndarray, "*n 4 4"], on_hand: bool
    ) -> Float[np.ndarray, "*n 4 4"]:
        """Return the board's pose in the camera's frame, by the hand's in the base's."""
        moved = np.linalg.inv(hands) if on_hand else hands
        return inverse(self.camera) @ moved @ self.board


class Bundle:
    """Least squares over the corners of all views and the errors of the hand in each."""

    def __init__(
        self,
        views: Sequence[BoardView],
        hands: Sequence[Transform],
        on_hand: bool,
        start: Estimate,
        noise: float,
    ) -> None:
        """`noise` is the standard deviation of a corner's pixel, px."""
        self._hands, self._on_hand = np.array(hands), on_hand
        self._start, self._noise = start, noise
        self._arm_share = 1.0  # of _ARM_NOISE
        self._view = np.repeat(np.arange(len(views)), [len(view.points) for view in views])
        self._points = np.concatenate([view.points for view in views])
        self._pixels = np.concatenate([view.pixels for view in views])

    def fit(self) -> tuple[Estimate, list[Estimate], float, float]:
        """Return the estimate, that without each view, reprojection error (rms, px) and arm noise (m).

        Without a view: one step of Newton's method from the whole. numpy's LinAlgError where the views
        do not fix a parameter.
        """
        fit = self._solve(np.zeros(_SHARED + 6 * len(self._hands)))
        for _ in range(_ROUNDS):  # MacKay's update of a prior's variance
            errors, inverted = fit.x[_SHARED:], np.linalg.inv(fit.jac.T @ fit.jac)
            determined = errors.size - np.trace(inverted[_SHARED:, _SHARED:])
            factor = max(np.sqrt(errors @ errors / determined), _LEAST_SHARE / self._arm_share)
            self._arm_share *= factor
            fit = self._solve(np.concatenate([fit.x[:_SHARED], errors / factor]))
        J, residuals, owner = fit.jac, fit.fun, np.repeat(self._view, 2)
        H, without = J.T @ J, []
        for i in range(len(self._hands)):
            rows = np.flatnonzero(owner == i)
            step = np.linalg.solve(H - J[rows].T @ J[rows], J[rows].T @ residuals[rows])
            without.append(self._estimate(fit.x + step))
        squares = (self._noise * residuals[: owner.size]) ** 2
        pixel_error = float(np.sqrt(2 * np.mean(squares)))
        return self._estimate(fit.x), without, pixel_error, self._arm_share * float(_ARM_NOISE[-1])

    def _solve(self, start: Float[np.ndarray, " p"]) -> OptimizeResult:
        jacobian: Any = self._jacobian  # scipy's stub knows names of methods alone
        return least_squares(self._residuals, start, jacobian, x_scale="jac", method="lm")

    def _estimate(self, parameters: Float[np.ndarray, " p"]) -> Estimate:
        start = self._start
        own = start.lens
        lens = np.array([own.fx, own.fy, own.cx, own.cy, own.k1, own.k2])
        lens += parameters[:6] * [own.fx, own.fy, own.fx, own.fy, 1.0, 1.0]
        return Estimate(
            Lens(*lens.tolist()),
            start.camera @ transform(parameters[6:12]),
            start.board @ transform(parameters[12:18]),
            start.scale * float(np.exp(parameters[18])),
        )

    def _residuals(self, parameters: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        """Return the errors of pixels, then of the hand, in standard deviations."""
        estimate, errors = self._estimate(parameters), parameters[_SHARED:]
        off = errors.reshape(-1, 6) * self._arm_share * _ARM_NOISE
        moves = np.tile(np.eye(4), (len(off), 1, 1))
        moves[:, :3, :3], moves[:, :3, 3] = Rotation.from_rotvec(off[:, :3]).as_matrix(), off[:, 3:]
        poses = estimate.board_seen(self._hands @ moves, self._on_hand)[self._view]
        points = np.einsum("kij,kj->ki", poses[:, :3, :3], estimate.scale * self._points)
        error = _project(points + poses[:, :3, 3], estimate.lens) - self._pixels
        return np.concatenate([error.ravel() / self._noise, errors])

    def _jacobian(self, parameters: Float[np.ndarray, " p"]) -> Float[np.ndarray, "r p"]:
        """Return central differences; one axis of the hand's error is changed in all views at once."""
        pixels = np.arange(2 * self._view.size)
        unit = np.eye(parameters.size)
        J = np.concatenate([np.zeros((pixels.size, parameters.size)), unit[_SHARED:]])
        for j in range(_SHARED + 6):
            shared = j < _SHARED
            change = _STEP * (unit[j] if shared else unit[j::6].sum(axis=0))
            ends = [self._residuals(parameters + change), self._residuals(parameters - change)]
            column = j if shared else j + 6 * np.repeat(self._view, 2)
            J[pixels, column] = (ends[0] - ends[1])[pixels] / (2 * _STEP)
        return J


def _project(points: Float[np.ndarray, "k 3"], lens: Lens) -> Float[np.ndarray, "k 2"]:
    x, y, z = points.T
    x, y = x / z, y / z
    r2 = x * x + y * y
    stretch = 1 + r2 * (lens.k1 + lens.k2 * r2)
    return np.stack([lens.fx * stretch * x + lens.cx, lens.fy * stretch * y + lens.cy], axis=1)


def transform(change: Float[np.ndarray, "6"]) -> Transform:
    """Return the transform of a rotation vector (rad), then a shift (m)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(change[:3]), change[3:]
    return T


def inverse(T: Transform) -> Transform:
    """Return the inverse of a transform."""
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return back

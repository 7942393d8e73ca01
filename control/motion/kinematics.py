"""Forward kinematics, Jacobian and inverse kinematics of an arm with a tool, by CasADi.

Frames: `base` is the robot's first link, `flange` its last, `tcp` the tool centre point, between
the two fingertip sensors. Positions in metres, rotations as 3x3 matrices, angles in radians.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi
import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.arm_models import ArmModel, Joints
from touchgoal.control.motion.rotations import Matrix3, Vector3
from touchgoal.runtime.errors import UserError

# m^2: makes steps finite at a singularity. The squared error is added to it, so that a step from afar
# goes no farther than the linearisation holds (Sugihara 2011).
DAMPING = 1e-6
_TASK_STEP = 0.1, 0.5  # m and rad, longest step
_MARGIN = 1e-4  # rad that solutions keep from the joints' limits
_ITERATIONS = 50
_PULLED = 8  # first iterations, in which the pull towards home fades to zero
# Number of other starts. Of 1,000 reachable poses with random rotations the FR3 finds 66 % from home
# and 100 % with these, the UR5e 54 % and 99.9 %.
_RESTARTS = 48
# of squared errors: 10 mrad count as 1 mm
_ERROR_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])


def _rotation(axis: str, angle: casadi.SX | float) -> casadi.SX:
    c, s = casadi.cos(angle), casadi.sin(angle)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}
    return casadi.SX(casadi.vertcat(*(casadi.horzcat(*row) for row in rows[axis])))


def _frames(arm: ArmModel, q: casadi.SX) -> list[tuple[casadi.SX, casadi.SX]]:
    """Return origin and rotation of the base, of each link behind its joint, and of the hand."""
    p, R = casadi.SX.zeros(3), casadi.SX.eye(3)
    frames = [(p, R)]
    for i, (offset, twist) in enumerate(arm.links):
        p = p + R @ casadi.DM(offset)
        R = R @ _rotation("x", twist) @ _rotation("z", q[i])
        frames.append((p, R))
    return [*frames, (p + R[:, 2] * arm.flange_offset, R @ _rotation("z", arm.hand_yaw))]


def _chain(arm: ArmModel, tcp_offset: float) -> casadi.Function:
    """Return the CasADi function q -> TCP position (3), rotation (3, 3), geometric Jacobian (6, n)."""
    q = casadi.SX.sym("q", len(arm.links))
    _, *joints, (hand, R) = _frames(arm, q)
    p = hand + R[:, 2] * tcp_offset
    columns = [casadi.vertcat(casadi.cross(r[:, 2], p - o), r[:, 2]) for o, r in joints]
    return casadi.Function("chain", [q], [p, R, casadi.horzcat(*columns)])


def _step(arm: ArmModel, tcp_offset: float) -> casadi.Function:
    """Return the CasADi function of one step of damped least squares; one call takes 6 us.

    (q, target position and rotation by rows (12), posture, free, held) -> change of q, pose error
    of q (6: m, rad). Joints where `free` is 0 change by `held` (rad); the others solve the task.
    """
    n = len(arm.links)
    q, target, posture, free, held = (
        casadi.SX.sym(name, k)
        for name, k in (("q", n), ("target", 12), ("p", 1), ("f", n), ("h", n))
    )
    p, R, J = _chain(arm, tcp_offset)(q)
    error = casadi.vertcat(
        target[:3] - p, _rotation_error(casadi.reshape(target[3:], 3, 3).T @ R.T)
    )
    bound = casadi.DM([*[_TASK_STEP[0]] * 3, *[_TASK_STEP[1]] * 3])
    task = casadi.fmin(casadi.fmax(error, -bound), bound)
    damping = DAMPING + casadi.dot(casadi.DM(_ERROR_WEIGHTS), error**2)
    given = free * posture * (arm.home - q) + (1 - free) * held
    # Solving for the error that remains after `given` keeps only the null-space part of `given`.
    Jf = J @ casadi.diag(free)
    factors = casadi.ldl(Jf @ Jf.T + damping * casadi.SX.eye(6))
    change = given + Jf.T @ casadi.ldl_solve(task - J @ given, *factors)
    return casadi.Function("step", [q, target, posture, free, held], [change, error])


def _rotation_error(R: casadi.SX) -> casadi.SX:
    """Return `rotation_vector` for CasADi, by the largest of four forms of the quaternion."""
    skew = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    signs = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
    squares = [1 + sum(s * R[i, i] for i, s in enumerate(sign)) for sign in signs]
    rows = [[squares[0], *skew]]
    for i in range(3):
        mixed = [squares[i + 1] if k == i else R[i, k] + R[k, i] for k in range(3)]
        rows.append([skew[i], *mixed])
    best, quaternion = squares[0], casadi.vertcat(*rows[0])
    for square, row in zip(squares[1:], rows[1:], strict=True):
        quaternion = casadi.if_else(square > best, casadi.vertcat(*row), quaternion)
        best = casadi.fmax(best, square)
    w, v = casadi.fabs(quaternion[0]), quaternion[1:] * casadi.if_else(quaternion[0] < 0, -1, 1)
    sine = casadi.norm_2(v)
    factor = 2 * casadi.atan2(sine, w) / casadi.fmax(sine, 1e-300)
    return v * casadi.if_else(sine > 1e-12, factor, 2 / w)


@dataclass(frozen=True)
class IkSolution:
    """Joint positions (rad) with their remaining error, m and rad."""

    q: Joints
    position_error: float
    rotation_error: float

    @property
    def reached(self) -> bool:
        """Whether the error is within 0.1 mm and 1 mrad."""
        return self.position_error < 1e-4 and self.rotation_error < 1e-3


class Kinematics:
    """An arm with a tool whose centre point lies `tcp_offset` m along the hand's z axis."""

    def __init__(self, arm: ArmModel, tcp_offset: float) -> None:
        self.arm = arm
        self._chain = _chain(arm, tcp_offset)
        self._step = _step(arm, tcp_offset)
        rng = np.random.default_rng(0)
        size = (_RESTARTS, arm.home.size)
        reach = arm.limits.with_margin(_MARGIN)
        self._postures = rng.uniform(reach.lower, reach.upper, size)

    def forward(self, q: Joints) -> tuple[Vector3, Matrix3]:
        """Return the TCP position (m) and rotation in the base frame."""
        p, R, _ = self._chain(q)
        return p.full().ravel(), R.full()

    def jacobian(self, q: Joints) -> Float[np.ndarray, "6 n"]:
        """Return the geometric Jacobian of the TCP, base frame: linear rows (m/rad), then angular."""
        return self._chain(q)[2].full()

    def joint_change(self, q: Joints, change: Float[np.ndarray, "6"]) -> Joints:
        """Return the least joint change (rad) for a small shift (m) and turn (rad) of the TCP.

        Base frame; damped at singularities.
        """
        J = self.jacobian(q)
        return J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), change)

    def forward_many(
        self, q: Float[np.ndarray, "b n"]
    ) -> tuple[Float[np.ndarray, "b 3"], Float[np.ndarray, "b 3 3"], Float[np.ndarray, "b 6 n"]]:
        """Return `forward` and `jacobian` for many joint positions."""
        p, R, J = (side_by_side.full() for side_by_side in self._chain.map(len(q))(q.T))
        blocks = J.reshape(6, *q.shape).transpose(1, 0, 2)
        return p.T, R.reshape(3, len(q), 3).transpose(1, 0, 2), blocks

    def solve_ik_near(
        self,
        position: Vector3,
        rotation: Matrix3,
        start: Joints,
        *,
        posture: float = 0.02,
        tolerance: float = 1e-5,
    ) -> IkSolution:
        """Solve by damped least squares from `start`, near which the solution lies.

        A joint that would leave its range is held at its limit, and the others solve the task. With
        more than six joints, each step pulls the arm home by the share `posture`, so that the elbow
        stays where a person expects it; with 0 the joints move least. It stops within `tolerance` m
        and ten times that in rad, or after the last iteration.
        """
        reach = self.arm.limits.with_margin(_MARGIN)
        lower, upper = reach.lower, reach.upper
        q, target = np.array(start, dtype=np.float64), np.concatenate([position, rotation.ravel()])
        change, held = np.empty(q.size), np.zeros(q.size)
        free, pull, error = np.ones(q.size), np.empty(1), np.full(6, np.inf)
        posture = posture if q.size > 6 else 0.0
        buffer, step = self._step.buffer()
        for i, value in enumerate((q, target, pull, free, held)):
            buffer.set_arg(i, value.data)  # pyright: ignore[reportCallIssue]
        for i, value in enumerate((change, error)):
            buffer.set_res(i, value.data)  # pyright: ignore[reportCallIssue]
        for i in range(_ITERATIONS):
            free[:], pull[0] = 1.0, posture * max(0.0, 1 - i / _PULLED)
            step()
            if error @ (error * _ERROR_WEIGHTS) < tolerance**2:
                break
            wanted = q + change
            beyond = (wanted < lower) | (wanted > upper)
            while beyond.any():
                free[beyond] = 0.0
                held[beyond] = np.clip(wanted, lower, upper)[beyond] - q[beyond]
                step()
                wanted = q + change
                beyond = ((wanted < lower) | (wanted > upper)) & (free > 0)
            q[:] = np.clip(wanted, lower, upper)
        return IkSolution(q, float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:])))

    def solve_ik(self, position: Vector3, rotation: Matrix3, start: Joints) -> Joints:
        """Return joint positions for a pose; UserError if the arm cannot reach it.

        If `start` leads to no solution, other starts are tried; the result may then be far from it.
        """
        solution = self.solve_ik_near(position, rotation, start)
        for posture in self._postures:
            if solution.reached:
                return solution.q
            other = self.solve_ik_near(position, rotation, posture)
            solution = other if other.reached else solution
        raise UserError(
            f"the {self.arm.name} cannot reach {np.round(position, 3).tolist()} m in this "
            f"orientation (off by {1e3 * solution.position_error:.1f} mm, "
            f"{solution.rotation_error:.3f} rad); move the target closer"
        )

    def points_on_links(
        self, points: Float[np.ndarray, "k 3"], frames: Sequence[int] | None = None
    ) -> casadi.Function:
        """Return the CasADi function of joints (n, m) -> points (m) fixed to parts of the arm.

        `frames` names the part and frame of each point: 0 the base, i the link behind joint i, n +
        1 the hand; None: all on the hand. The result (3, m k) has the k points of the first column
        first, in the base frame.
        """
        q = casadi.SX.sym("q", self.arm.home.size)
        placed = _frames(self.arm, q)
        on = frames or [len(placed) - 1] * len(points)
        columns = [
            placed[i][0] + placed[i][1] @ casadi.DM(point)
            for i, point in zip(on, points, strict=True)
        ]
        return casadi.Function("points", [q], [casadi.horzcat(*columns)])

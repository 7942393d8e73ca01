"""Kinematics of the FR3 and the UR5e with a tool: forward, Jacobian, inverse, by CasADi.

Frames: `base` is the robot's first link, `flange` its last, `tcp` the tool centre point, between
the two fingertip sensors. Positions in metres, rotations as 3x3 matrices, angles in radians.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi
import numpy as np
from jaxtyping import Float

from touchgoal.control.errors import UserError

Vector3 = Float[np.ndarray, "3"]
Matrix3 = Float[np.ndarray, "3 3"]
Joints = Float[np.ndarray, "n"]

# Origin (m) and rotation about x (rad) of each joint frame in the one before it; every joint turns
# about its own z. Source: Franka's FR3 description, as shipped in franky-sim's fr3.xml.
_FR3_LINKS = (
    ((0.0, 0.0, 0.333), 0.0),
    ((0.0, 0.0, 0.0), -np.pi / 2),
    ((0.0, -0.316, 0.0), np.pi / 2),
    ((0.0825, 0.0, 0.0), np.pi / 2),
    ((-0.0825, 0.384, 0.0), -np.pi / 2),
    ((0.0, 0.0, 0.0), np.pi / 2),
    ((0.088, 0.0, 0.0), np.pi / 2),
)

# rad; franka_description joint_limits.yaml.
FR3_LOWER = np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159])
FR3_UPPER = np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159])
# A comfortable elbow-up posture over the table, fingers down.
FR3_HOME = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 1.9, np.pi / 4])

# The same from Universal Robots' Denavit-Hartenberg table (article 45257, e-Series 5.1): a, d and
# alpha of joint i place the frame of joint i + 1. Base frame: the controller's, not ROS's.
_UR5E_LINKS = (
    ((0.0, 0.0, 0.0), 0.0),
    ((0.0, 0.0, 0.1625), np.pi / 2),
    ((-0.425, 0.0, 0.0), 0.0),
    ((-0.3922, 0.0, 0.0), 0.0),
    ((0.0, 0.0, 0.1333), np.pi / 2),
    ((0.0, 0.0, 0.0997), -np.pi / 2),
)

# rad; Universal_Robots_ROS2_Description ur5e/joint_limits.yaml (the elbow would hit the arm).
UR5E_UPPER = np.array([2.0, 2.0, 1.0, 2.0, 2.0, 2.0]) * np.pi
UR5E_LOWER = -UR5E_UPPER
# Elbow up, reaching along +x, tool straight down.
UR5E_HOME = np.array([0.0, -1.9, -1.8, 3.7 - 1.5 * np.pi, np.pi / 2, -np.pi / 2])

# Tool centre point in the hand frame, along z (m): finger carriage 58.4 mm below the hand frame
# (fr3.xml), the adapter's bolt axis 12 mm below that (read off the finger mesh's bolt recess), the
# sensor's centre 67 mm below the bolts (GelSight's Panda adapter STEP file).
GELSIGHT_TCP = 0.0584 + 0.012 + 0.067


_DAMPING = 1e-6  # m^2
_TASK_STEP = 0.1, 0.5  # m and rad, farthest that a step goes
_MARGIN = 0.02  # rad that solutions keep from the joints' limits
_RESTARTS = (
    48  # of 3000 reachable poses in any orientation 81 % are found from home, all from these
)
# Of squared errors: 10 mrad count as 1 mm.
_ERROR_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])


def _rotation(axis: str, angle: casadi.SX | float) -> casadi.SX:
    c, s = casadi.cos(angle), casadi.sin(angle)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}
    return casadi.SX(casadi.vertcat(*(casadi.horzcat(*row) for row in rows[axis])))


@dataclass(frozen=True)
class ArmModel:
    """A serial arm: links as above, flange_offset (m beyond the last joint, along its z), limits (rad).

    `hand_yaw` (rad) turns the hand on the flange; `home` is where the inverse rests.
    """

    name: str
    links: tuple[tuple[tuple[float, float, float], float], ...]
    flange_offset: float
    hand_yaw: float
    lower: Joints
    upper: Joints
    home: Joints


FR3_ARM = ArmModel("FR3", _FR3_LINKS, 0.107, -np.pi / 4, FR3_LOWER, FR3_UPPER, FR3_HOME)
UR5E_ARM = ArmModel("UR5e", _UR5E_LINKS, 0.0996, 0.0, UR5E_LOWER, UR5E_UPPER, UR5E_HOME)


def _frames(arm: ArmModel, q: casadi.SX) -> list[tuple[casadi.SX, casadi.SX]]:
    """Origin and rotation of the base, of each link behind its joint, and of the hand."""
    p, R = casadi.SX.zeros(3), casadi.SX.eye(3)
    frames = [(p, R)]
    for i, (offset, twist) in enumerate(arm.links):
        p = p + R @ casadi.DM(offset)
        R = R @ _rotation("x", twist) @ _rotation("z", q[i])
        frames.append((p, R))
    return [*frames, (p + R[:, 2] * arm.flange_offset, R @ _rotation("z", arm.hand_yaw))]


def _chain(arm: ArmModel, tcp_offset: float) -> casadi.Function:
    """CasADi function q -> TCP position (3), rotation (3, 3), geometric Jacobian (6, n)."""
    q = casadi.SX.sym("q", len(arm.links))
    _, *joints, (hand, R) = _frames(arm, q)
    p = hand + R[:, 2] * tcp_offset
    columns = [casadi.vertcat(casadi.cross(r[:, 2], p - o), r[:, 2]) for o, r in joints]
    return casadi.Function("chain", [q], [p, R, casadi.horzcat(*columns)])


def _step(arm: ArmModel, tcp_offset: float) -> casadi.Function:
    """CasADi function of one step of damped least squares, for `Kinematics.solve_ik_near`.

    (q, target position and rotation by rows (12), posture) -> next q, pose error of q (6: m, rad).
    All in one function, so that a step is one call: 6 us, of which a numpy version would spend most
    between its calls.
    """
    n = len(arm.links)
    q, target, posture = (
        casadi.SX.sym(name, k) for name, k in (("q", n), ("target", 12), ("p", 1))
    )
    p, R, J = _chain(arm, tcp_offset)(q)
    error = casadi.vertcat(
        target[:3] - p, _rotation_error(casadi.reshape(target[3:], 3, 3).T @ R.T)
    )
    bound = casadi.DM([*[_TASK_STEP[0]] * 3, *[_TASK_STEP[1]] * 3])
    task = casadi.fmin(casadi.fmax(error, -bound), bound)
    pull = posture * (arm.home - q)
    # Least squares for what the pull leaves to do is the pull's part in the null space, and the task.
    factors = casadi.ldl(J @ J.T + _DAMPING * casadi.SX.eye(6))
    change = pull + J.T @ casadi.ldl_solve(task - J @ pull, *factors)
    lower, upper = arm.lower + _MARGIN, arm.upper - _MARGIN
    nearer = casadi.fmin(casadi.fmax(q + change, lower), upper)
    return casadi.Function("step", [q, target, posture], [nearer, error])


def _rotation_error(R: casadi.SX) -> casadi.SX:
    """`rotation_vector` for CasADi: by the quaternion, from the largest of four ways to get it."""
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
    """Joint positions (rad) with what is left of the error, in m and rad."""

    q: Joints
    position_error: float
    rotation_error: float

    @property
    def reached(self) -> bool:
        """Within 0.1 mm and 1 mrad."""
        return self.position_error < 1e-4 and self.rotation_error < 1e-3


class Kinematics:
    """An arm with a tool whose centre point lies `tcp_offset` m along the hand's z axis."""

    def __init__(self, arm: ArmModel, tcp_offset: float) -> None:
        self.arm = arm
        self._chain = _chain(arm, tcp_offset)
        self._step = _step(arm, tcp_offset)
        rng = np.random.default_rng(0)
        size = (_RESTARTS, arm.home.size)
        self._postures = rng.uniform(arm.lower + _MARGIN, arm.upper - _MARGIN, size)

    def forward(self, q: Joints) -> tuple[Vector3, Matrix3]:
        """TCP position (m) and rotation in the base frame."""
        p, R, _ = self._chain(q)
        return p.full().ravel(), R.full()

    def jacobian(self, q: Joints) -> Float[np.ndarray, "6 n"]:
        """Geometric Jacobian of the TCP, base frame: linear rows (m/rad), then angular."""
        return self._chain(q)[2].full()

    def jacobians(
        self, q: Float[np.ndarray, "b n"]
    ) -> tuple[Float[np.ndarray, "b 6 n"], Float[np.ndarray, "b 3 3"]]:
        """`jacobian` of many joint positions at once, and the TCP's rotations there."""
        _, R, J = (side_by_side.full() for side_by_side in self._chain.map(len(q))(q.T))
        return J.reshape(6, *q.shape).transpose(1, 0, 2), R.reshape(3, len(q), 3).transpose(1, 0, 2)

    def solve_ik_near(
        self,
        position: Vector3,
        rotation: Matrix3,
        start: Joints,
        *,
        iterations: int = 60,
        posture: float = 0.02,
        tolerance: float = 1e-5,
    ) -> IkSolution:
        """Damped least squares from `start`, drawn to the arm's home in the null space.

        Damping keeps steps finite near singularities; `posture` (share a step) keeps the elbow where
        a person expects it; 0 moves the joints least. Joints stay 0.02 rad inside their limits. It
        ends within `tolerance` m and ten times that in rad, or without, near where it began.
        """
        q, nearer, error = (
            np.array(start, dtype=np.float64),
            np.empty(len(start)),
            np.full(6, np.inf),
        )
        target = np.concatenate([position, rotation.ravel()])
        buffer, step = self._step.buffer()
        inputs, results = (
            (q, target, np.array([posture])),
            (nearer, error),
        )  # kept: it points to them
        for i, value in enumerate(inputs):
            buffer.set_arg(i, value.data)  # pyright: ignore[reportCallIssue]
        for i, value in enumerate(results):
            buffer.set_res(i, value.data)  # pyright: ignore[reportCallIssue]
        for _ in range(iterations):
            step()
            left = error @ (error * _ERROR_WEIGHTS)
            if left < tolerance**2:
                break
            q[:] = nearer
        return IkSolution(q, float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:])))

    def solve_ik(self, position: Vector3, rotation: Matrix3, start: Joints) -> Joints:
        """Joint positions for a pose; UserError if the arm cannot reach it.

        If there is no way from `start`, another posture is looked for, which may be far from it.
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
        """CasADi function of joint positions (n, m) -> points (m) fixed to parts of the arm.

        `frames` says of each point which part it is on and in whose frame it is given (m): 0 the
        base, i the link behind joint i, n + 1 the hand; None: all on the hand. The result (3, m k)
        has the k points of the first column first, in the base frame.
        """
        q = casadi.SX.sym("q", self.arm.home.size)
        placed = _frames(self.arm, q)
        on = frames or [len(placed) - 1] * len(points)
        columns = [
            placed[i][0] + placed[i][1] @ casadi.DM(point)
            for i, point in zip(on, points, strict=True)
        ]
        return casadi.Function("points", [q], [casadi.horzcat(*columns)])


class Fr3Kinematics(Kinematics):
    """The FR3 with the Franka Hand."""

    def __init__(self, tcp_offset: float = GELSIGHT_TCP) -> None:
        super().__init__(FR3_ARM, tcp_offset)


class Ur5eKinematics(Kinematics):
    """The UR5e with a gripper on its flange."""

    def __init__(self, tcp_offset: float = GELSIGHT_TCP) -> None:
        super().__init__(UR5E_ARM, tcp_offset)


def rotation_vector(R: Matrix3) -> Vector3:
    """Axis times angle (rad) of a rotation matrix."""
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
    """The rotation about `vector` by its length (rad): Rodrigues, the inverse of the above."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-12)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def fingers_down(yaw: float) -> Matrix3:
    """TCP rotation in the base frame: approach straight down, hand turned by `yaw` about base z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def fingers_across(direction: Vector3) -> Matrix3:
    """TCP rotation in the base frame: x along a direction, approach as straight down as that lets.

    The fingers then close across the direction. It must not be vertical.
    """
    x = direction / np.linalg.norm(direction)
    z = np.array([0.0, 0.0, -1.0]) + x[2] * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)

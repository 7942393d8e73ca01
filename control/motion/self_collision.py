"""Self-collision: the arm's parts as capsules, and the least gap between any two that may meet."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from touchgoal.control.motion.arm_models import FR3_ARM, UR5E_ARM, ArmModel
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.control.motion.tool import Point
from touchgoal.control.motion.trajectories import Trajectory
from touchgoal.runtime.errors import UserError

Points = Float[np.ndarray, "*k 3"]


@dataclass(frozen=True)
class Capsule:
    """All points within `radius` (m) of a segment in the frame of a part (see Kinematics.points_on_links)."""

    frame: int
    start: Point
    end: Point
    radius: float


def _hand(frame: int) -> tuple[Capsule, ...]:
    """Return a Franka Hand with GelSight Minis at any opening (70 mm to each side)."""
    return (
        Capsule(frame, (0.0, 0.06, 0.03), (0.0, -0.08, 0.02), 0.051),
        Capsule(frame, (0.0, 0.055, 0.08), (0.0, -0.055, 0.08), 0.038),
        Capsule(frame, (0.0, 0.055, 0.125), (0.0, -0.055, 0.125), 0.038),
    )


# Fitted to the collision meshes in franky-sim's fr3.xml: least volume, radii rounded up to cover
# every vertex (a test holds this); axes rounded to centimetres.
_FR3 = (
    Capsule(0, (0.0, 0.0, 0.05), (-0.06, 0.0, 0.02), 0.108),
    Capsule(1, (0.0, -0.07, -0.01), (0.0, -0.04, 0.0), 0.069),
    Capsule(1, (0.0, -0.02, -0.08), (0.0, 0.0, -0.16), 0.069),
    Capsule(2, (0.0, -0.16, 0.0), (0.0, -0.07, 0.03), 0.066),
    Capsule(2, (0.0, 0.0, 0.03), (0.0, 0.0, 0.07), 0.065),
    Capsule(3, (0.0, 0.0, -0.07), (0.0, 0.0, -0.1), 0.068),
    Capsule(3, (0.08, 0.03, 0.0), (0.07, 0.05, 0.0), 0.073),
    Capsule(4, (-0.08, 0.11, 0.0), (-0.08, 0.06, 0.0), 0.066),
    Capsule(4, (-0.01, 0.01, 0.06), (0.0, 0.0, 0.03), 0.069),
    Capsule(5, (0.0, 0.08, 0.0), (0.0, 0.05, 0.0), 0.066),
    Capsule(5, (-0.01, 0.09, -0.1), (0.0, 0.0, -0.24), 0.064),
    Capsule(6, (0.0, 0.0, 0.01), (0.03, 0.01, 0.02), 0.057),
    Capsule(6, (0.08, 0.04, 0.0), (0.09, -0.03, 0.0), 0.057),
    Capsule(7, (-0.01, -0.01, 0.07), (0.03, 0.03, 0.08), 0.053),
    *_hand(8),
)

# Axes from Universal_Robots_ROS2_Description (shoulder offset 0.138 m, forearm 0.007 m beside the
# shoulder's plane); radii are our reading of UR's drawing, rounded up. The hand is the same.
_UR5E = (
    Capsule(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.09), 0.08),
    Capsule(1, (0.0, 0.0, 0.163), (0.0, -0.07, 0.163), 0.075),
    Capsule(2, (0.0, 0.0, 0.138), (-0.425, 0.0, 0.138), 0.065),
    Capsule(3, (0.0, 0.0, 0.007), (-0.3922, 0.0, 0.007), 0.06),
    Capsule(4, (0.0, 0.0, 0.03), (0.0, 0.0, 0.1333), 0.055),
    Capsule(5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0997), 0.055),
    Capsule(6, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0996), 0.05),
    *_hand(7),
)

_BODIES = {FR3_ARM.name: _FR3, UR5E_ARM.name: _UR5E}
_POINT = 1e-12  # m^2; a shorter segment is a point
_LEAST_GAP = 5e-3  # m
_NEIGHBOURS = 3  # parts fewer joints apart are not checked: the joints' ranges keep them apart


class SelfDistance:
    """Gaps between the parts of one arm."""

    def __init__(self, arm: ArmModel) -> None:
        body = self.body = _BODIES[arm.name]
        ends = np.array([point for capsule in body for point in (capsule.start, capsule.end)])
        frames = [capsule.frame for capsule in body for _ in range(2)]
        self._ends = Kinematics(arm, 0.0).points_on_links(ends, frames)
        part = np.array([capsule.frame for capsule in body])
        self._first, self._second = np.nonzero(part - part[:, None] >= _NEIGHBOURS)
        radius = np.array([capsule.radius for capsule in body])
        self._radii = radius[self._first] + radius[self._second]

    def gap(self, q: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " k"]:
        """Return the least distance (m) between parts for each posture; negative where they overlap."""
        ends = self._ends(q.T).full().T.reshape(len(q), -1, 2, 3)
        first, second = ends[:, self._first], ends[:, self._second]
        apart = segment_distance(*np.moveaxis(first, -2, 0), *np.moveaxis(second, -2, 0))
        return (apart - self._radii).min(axis=1)


def require_no_self_collision(trajectory: Trajectory, distance: SelfDistance) -> None:
    """UserError if parts of the arm come closer than 5 mm on the way (checked at 100 Hz)."""
    gap = distance.gap(trajectory.sample(100))
    if gap.min() < _LEAST_GAP:
        k = int(np.argmax(gap < _LEAST_GAP))
        raise UserError(
            f"the arm would come within {1e3 * _LEAST_GAP:.0f} mm of itself {k / 100:.1f} s after the "
            "move's start: go by way of another posture"
        )


def segment_distance(a: Points, b: Points, c: Points, d: Points) -> Float[np.ndarray, "*k"]:
    """Return the least distance (m) between the segments `a`-`b` and `c`-`d`, points included.

    Ericson, Real-Time Collision Detection, 5.1.9.
    """
    u, v, w = b - a, d - c, a - c
    uv = (u * v).sum(-1)
    uu, vv = (np.maximum((x * x).sum(-1), _POINT) for x in (u, v))
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    across = uu * vv - uv**2
    s = np.clip((uv * vw - uw * vv) / np.maximum(across, _POINT), 0, 1)  # any if parallel
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    return np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)

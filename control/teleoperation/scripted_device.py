"""Scripted teleoperation device for rehearsals without a person: it picks and places.

A simulator gives it the poses of object and goal. It requests hand motions, as a SpaceMouse does,
from the observed pose of the hand and width of the gripper. As people do, it goes no two ways alike,
comes down beside its aim and corrects: a policy learns corrections from no other demonstrations
(DART, Laskey et al. 2017), and to see from no other places.
"""

from collections import deque
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from touchgoal.control import features as ft
from touchgoal.control.deployment.scripted import PickPlacePoses
from touchgoal.control.features import Observation
from touchgoal.control.motion.rotations import Vector3, fingers_down, rotation_vector
from touchgoal.control.teleoperation.device import GripperRequest, HandMotion, TeleoperationDevice

_SLOW_WITHIN = 0.06, 0.4  # m and rad from a way-point within which the deflection shrinks
_REACHED, _PASSED = (0.004, 0.03), (0.012, 0.1)  # m and rad from a way-point
_CLEARANCE = 0.07, 0.16  # m above the object, between which the hand goes
# Standard deviations of its way-points, half-way, above and low above the end: m along each axis, and rad
# with an open hand, which turns as late as it can, and with an object
_ASIDE = 0.04, 0.02, 0.008
_TURNED = {"open": (0.8, 0.5, 0.1), "close": (0.1, 0.1, 0.1)}
_MOST_TURNED = 1.8  # rad about the vertical that the arm reaches everywhere on the table
_LOW = 0.06  # m; the fingertips are above what is grasped
# m above what it let go, mean and standard deviation, where the hand stands still in the end
_LEFT = 0.12, 0.01
_STILL_TICKS = 8  # ticks without motion: the hand has closed, or the table blocks it
_STILL = 4e-4  # m of position and of width that count as no motion
_PLACED = 0.015  # m between hand and goal
_HELD = 0.004  # m of width: less is an empty hand


class ScriptedDevice(TeleoperationDevice):
    """Goes from way-point to way-point; its verdict is "done" if it let an object go at the goal."""

    def __init__(self, poses: PickPlacePoses, seed: int) -> None:
        self._poses, self._rng = poses, np.random.default_rng(seed)
        self._recent: deque[np.ndarray] = deque(maxlen=_STILL_TICKS)  # position and width, m
        self._yaw = poses.grasp[3]  # of the hand at the object, rad
        self._motions = self._run()

    def read(self, observation: Observation) -> HandMotion:
        """Return the motion to the present way-point."""
        pose = observation[ft.TCP_POSE].astype(np.float64)
        self._position, self._width = pose[:3], float(observation[ft.STATE][-1])
        self._R = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
        self._recent.append(np.append(self._position, self._width))
        return next(self._motions)

    def _run(self) -> Iterator[HandMotion]:
        x, y, z, _ = self._poses.grasp
        pick, put = np.array([x, y, z]), np.array([*self._poses.goal, z])
        yield from self._go_down(pick, "open")
        yield from self._wait("close")
        yield from self._go(self._above(pick), 0.0, "close", _REACHED)
        yield from self._go_down(put, "close")
        there = np.linalg.norm((self._position - put)[:2]) < _PLACED and self._width > _HELD
        yield from self._wait("open")
        yield from self._go(put + [0, 0, self._rng.normal(*_LEFT)], 0.0, "open", _REACHED)
        yield from self._wait("open")
        self.verdict = "done" if there else "not done"
        while True:
            yield HandMotion(np.zeros(6), "open")

    def _go_down(self, point: Vector3, gripper: GripperRequest) -> Iterator[HandMotion]:
        half = self._above(np.append((self._position + point)[:2] / 2, point[2]))
        way = half, self._above(point), point + [0, 0, _LOW]
        for height, away, turned in zip(way, _ASIDE, _TURNED[gripper], strict=True):
            beside = height + np.append(self._rng.normal(0, away, 2), 0)
            yaw = np.clip(self._yaw + self._rng.normal(0, turned), -_MOST_TURNED, _MOST_TURNED)
            yield from self._go(beside, yaw - self._yaw, gripper, _PASSED)
            if gripper == "open":
                self._yaw = self._shorter_turn()
        yield from self._go(point, 0.0, gripper, _REACHED)

    def _shorter_turn(self) -> float:
        """Return the yaw to grasp at that is nearest to the hand's: half a turn on is as good."""
        now = np.arctan2(self._R[1, 0], self._R[0, 0])
        yaws = self._poses.grasp[3] + np.pi * np.arange(-1, 2)
        return float(min(yaws[np.abs(yaws) < _MOST_TURNED], key=lambda yaw: abs(yaw - now)))

    def _above(self, point: Vector3) -> Vector3:
        return point + [0, 0, self._rng.uniform(*_CLEARANCE)]

    def _go(
        self, point: Vector3, turn: float, gripper: GripperRequest, near: tuple[float, float]
    ) -> Iterator[HandMotion]:
        """Go to a way-point, turned by `turn` (rad) from the grasp's yaw, until so near it (m, rad) or blocked."""
        self._recent.clear()
        aim = fingers_down(self._yaw + turn)
        while not self._stands():
            away, error = point - self._position, rotation_vector(aim @ self._R.T)
            if np.linalg.norm(away) < near[0] and np.linalg.norm(error) < near[1]:
                return
            shares = (_limited(away / _SLOW_WITHIN[0]), _limited(error / _SLOW_WITHIN[1]))
            yield HandMotion(np.concatenate(shares), gripper)

    def _wait(self, gripper: GripperRequest) -> Iterator[HandMotion]:
        self._recent.clear()
        while not self._stands():
            yield HandMotion(np.zeros(6), gripper)

    def _stands(self) -> bool:
        moved = np.ptp(self._recent, axis=0).max() if self._recent else np.inf
        return len(self._recent) == _STILL_TICKS and bool(moved < _STILL)


def _limited(share: Vector3) -> Vector3:
    return share / max(1.0, float(np.linalg.norm(share)))

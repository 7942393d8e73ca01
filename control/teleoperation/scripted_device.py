"""Scripted teleoperation device for rehearsals without a person: it picks and places.

A simulator gives it the poses of object and goal. It requests hand motions, as a SpaceMouse does,
from the observed pose of the hand and width of the gripper.
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
_REACHED = 0.004, 0.03  # m and rad from a way-point
_CLEARANCE = 0.12  # m above the object
_STILL_TICKS = 8  # ticks without motion: the hand has closed, or the table blocks it
_STILL = 4e-4  # m of position and of width that count as no motion
_PLACED = 0.015  # m between hand and goal
_HELD = 0.004  # m of width: less is an empty hand


class ScriptedDevice(TeleoperationDevice):
    """Goes from way-point to way-point; its verdict is "done" if it ends with an object at the goal."""

    def __init__(self, poses: PickPlacePoses) -> None:
        self._poses = poses
        self._recent: deque[np.ndarray] = deque(maxlen=_STILL_TICKS)  # position and width, m
        self._R = fingers_down(poses.grasp[3])
        self._motions = self._run()

    def read(self, observation: Observation) -> HandMotion:
        """Return the motion to the present way-point."""
        pose = observation[ft.TCP_POSE].astype(np.float64)
        self._position, self._width = pose[:3], float(observation[ft.STATE][-1])
        R = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
        self._error = rotation_vector(self._R @ R.T)
        self._recent.append(np.append(self._position, self._width))
        return next(self._motions)

    def _run(self) -> Iterator[HandMotion]:
        x, y, z, _ = self._poses.grasp
        pick, put, up = np.array([x, y, z]), np.array([*self._poses.goal, z]), [0, 0, _CLEARANCE]
        yield from self._go(pick + up, "open")
        yield from self._go(pick, "open")
        yield from self._wait("close")
        for point in (pick + up, put + up, put):
            yield from self._go(point, "close")
        yield from self._wait("close")
        there = np.linalg.norm((self._position - put)[:2]) < _PLACED and self._width > _HELD
        self.verdict = "done" if there else "not done"
        while True:
            yield HandMotion(np.zeros(6), "close")

    def _go(self, point: Vector3, gripper: GripperRequest) -> Iterator[HandMotion]:
        self._recent.clear()
        while not self._stands():
            away = point - self._position
            if np.linalg.norm(away) < _REACHED[0] and np.linalg.norm(self._error) < _REACHED[1]:
                return
            shares = (_limited(away / _SLOW_WITHIN[0]), _limited(self._error / _SLOW_WITHIN[1]))
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

"""Scripted actors: the start move, and picking and placing by plan."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion import trajectories
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.control.motion.self_collision import SelfDistance, require_no_self_collision
from touchgoal.control.safety.action_filter import ActionFilter

_SPEED_SHARE = 0.9  # share of the policy's limits: a plan should not be clamped
# share of the policy's limits, for the start move: slow for the person who watches
_START_SPEED_SHARE = 0.3
_HELD_ERROR = 0.02  # rad; the arm was held: the plan waits until it has caught up
_MAX_LAG = 0.12  # rad between command and arm beyond which the plan waits; 0.06 is usual
_GRIPPER_MOVES = 5e-4  # m a tick; a gripper that moves less stands still
_CLEARANCE = 0.12  # m above the object before and after the grasp
_OFF_THE_FLOOR = 0.002, 0.0007  # m that fingertips keep above their box's floor: grasping, placing
_PROBE_DEPTH = 0.004  # m below the grasp's height to look for the table
_TABLE_FORCE = 2.5  # N upwards beyond the carried weight: the table carries the object
_CLOSE_SECONDS, _PROBE_SECONDS, _HOLD_SECONDS = 1.0, 3.0, 0.8  # closing, probing the table, end


@dataclass(frozen=True)
class PickPlacePoses:
    """Places, base frame: x, y, z (m) and yaw (rad) of the closing hand; x, y (m) of the goal."""

    grasp: tuple[float, float, float, float]
    goal: tuple[float, float]


@dataclass(frozen=True)
class PlannedMove:
    """A move along a path, or a wait (None), with the gripper's target width (m)."""

    path: trajectories.Trajectory | None
    width: float
    seconds: float  # duration, at least the path's own
    until_supported: bool = False  # end early once the table carries the object


class ScriptedActor(Actor):
    """Actor that walks through moves; the plan waits while the arm is held."""

    def __init__(self, moves: list[PlannedMove], commanded: Callable[[], np.ndarray], hz: float):
        """Begin joined moves at `hz`; `commanded` returns the joints (rad) commanded now."""
        self._commanded, self._tick = commanded, 1 / hz
        self._wrench, self._measured = np.zeros(6), commanded()
        self._width, self._gripper_still = np.inf, False
        self._actions = self._run(moves)

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """Return the action for the next tick."""
        self._wrench = observation[ft.WRENCH]
        self._measured = observation[ft.STATE][: self._measured.size].astype(np.float64)
        width = float(observation[ft.STATE][-1])
        self._gripper_still, self._width = abs(width - self._width) < _GRIPPER_MOVES, width
        return next(self._actions)

    def _run(self, moves: list[PlannedMove]) -> Iterator[np.ndarray]:
        still, width = np.zeros(self._commanded().size), 0.0
        for move in moves:
            width, t, weight = move.width, 0.0, self._wrench[2]
            while t < move.seconds:
                if move.until_supported and self._wrench[2] - weight > _TABLE_FORCE:
                    # Command the measured joints: the commanded ones would press on the table.
                    yield np.append(self._measured - self._commanded(), width)
                    break
                wanted = still
                lag = np.abs(self._commanded() - self._measured).max()
                if move.path is None:  # a wait: counts only while nothing moves
                    t = t + self._tick if self._gripper_still and lag < _HELD_ERROR else 0.0
                else:
                    pace = move.path.duration / move.seconds
                    at = move.path.at(pace * t)
                    if np.abs(at - self._commanded()).max() < _HELD_ERROR and lag < _MAX_LAG:
                        t += self._tick
                        at = move.path.at(pace * t)
                    wanted = at - self._commanded()
                yield np.append(wanted, width)
        self.done = True
        while True:
            yield np.append(still, width)


def start_move(
    goal: np.ndarray, width: float, safety: ActionFilter, commanded: Callable[[], np.ndarray]
) -> ScriptedActor:
    """Return the slow move to a posture (rad), the gripper staying at `width` (m).

    UserError if it leaves the workspace or leads the arm into itself.
    """
    limits = safety.joints.scaled(_START_SPEED_SHARE, _START_SPEED_SHARE)
    path = trajectories.joint_move(commanded(), goal, limits)
    trajectories.require_inside_workspace(path, safety)
    require_no_self_collision(path, SelfDistance(safety.limits.arm))
    return ScriptedActor([PlannedMove(path, width, path.duration)], commanded, 1 / safety.dt)


def pick_and_place(
    place: PickPlacePoses, safety: ActionFilter, commanded: Callable[[], np.ndarray]
) -> ScriptedActor:
    """Return the plan to grasp, carry, set down until the table carries the object, and hold it.

    UserError if the arm cannot go there inside its workspace.
    """
    robot = safety.limits
    kinematics = robot.kinematics()
    limits = safety.joints.scaled(_SPEED_SHARE, _SPEED_SHARE)
    x, y, z, yaw = place.grasp
    below = max(corner[2] for corner in robot.tool.finger_corners) - robot.tool.tcp_offset
    floor = float(safety.fingertips.lower[2]) + below  # the lowest that the TCP may be
    z = max(z, floor + _OFF_THE_FLOOR[0])
    pick, put = np.array([x, y, z]), np.array([*place.goal, z])
    deepest = np.array([*place.goal, max(z - _PROBE_DEPTH, floor + _OFF_THE_FLOOR[1])])
    up, opened = np.array([0, 0, _CLEARANCE]), robot.tool.stroke[1]
    q = commanded()

    def line(
        to: np.ndarray, width: float, least: float = 0.0, until_supported: bool = False
    ) -> PlannedMove:
        nonlocal q
        path = trajectories.straight_line(kinematics, q, to, fingers_down(yaw), limits)
        trajectories.require_inside_workspace(path, safety)
        q = path.at(path.duration)
        return PlannedMove(path, width, max(path.duration, least), until_supported)

    moves = [
        line(pick + up, opened),
        line(pick, opened),
        PlannedMove(None, 0.0, _CLOSE_SECONDS),
        line(pick + up, 0.0),
        line(put + up, 0.0),
        line(put + [0, 0, 0.004], 0.0),
        line(deepest, 0.0, _PROBE_SECONDS, until_supported=True),
        PlannedMove(None, 0.0, _HOLD_SECONDS),
    ]
    return ScriptedActor(moves, commanded, 1 / safety.dt)

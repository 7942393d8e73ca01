"""A scripted demonstrator with ground truth, which can also fail on purpose."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np

from touchgoal.control.features import Observation
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.hardware import GRIPPER_MAX_WIDTH
from touchgoal.sim_envs.config import Outcome
from touchgoal.sim_envs.pick_place import PickPlace

OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)

CLEARANCE = 0.12  # m above the object before and after the grasp
LOWEST_GRASP = 0.0185  # m: the sensor case (32.5 mm) must stay above the table
LOWEST_PLACE = 0.0172
TOUCHDOWN_DEPTH = 0.010  # m below the grasp's height to look for the table when placing


@dataclass(frozen=True)
class Waypoint:
    """Target of a straight minimum-jerk move, fingers down, with the gripper at `width`."""

    name: str
    position: np.ndarray | None  # TCP position at the end, m, base frame; None: stay
    width: float  # gripper target throughout, m
    seconds: float  # duration
    until_supported: bool = False  # end early once the table carries the object


class PickPlaceExpert:
    """Picks and places, or fails as `outcome` says.

    never_touch closes 8 cm above the object; drop lets go on the way; wrong_object takes the first
    distractor; freeze stops somewhere between the start and the goal.
    """

    def __init__(self, env: PickPlace, outcome: Outcome = "success") -> None:
        if outcome not in OUTCOMES:
            raise UserError(f"unknown outcome {outcome!r}; choose from: {', '.join(OUTCOMES)}")
        if outcome == "wrong_object" and len(env.bodies) < 2:
            raise UserError("outcome wrong_object needs a second object; set distractors to 1")
        self._env, self._outcome = env, outcome
        self._actions = self._run()

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next action, from ground truth; no motion once the plan is over."""
        return next(self._actions)

    def _run(self) -> Iterator[np.ndarray]:
        env = self._env
        position, _ = env.kinematics.forward(env.command)
        yaw, target_yaw = self._yaw_now(), self._env.grasp_yaw(self._picked)
        stop = self._freeze_tick()
        tick, width = 0, GRIPPER_MAX_WIDTH
        for waypoint in self._plan():
            ticks = round(waypoint.seconds * env.config.control_hz)
            start, start_yaw = position, yaw
            for k in range(1, ticks + 1):
                if waypoint.until_supported and env.object_on_table(self._picked):
                    # Command what is, not what was asked: the lag would press on the table.
                    position = env.data.site("tcp").xpos.copy()
                    break
                s = _minimum_jerk(k / ticks)
                if waypoint.position is not None:
                    position = start + s * (waypoint.position - start)
                yaw = start_yaw + s * (target_yaw - start_yaw)
                tick += 1
                if tick > stop:
                    break
                yield self._towards(position, yaw, waypoint.width)
            if tick > stop:
                break
            width = waypoint.width
        while True:
            yield np.append(np.zeros(env.n_joints), width)

    def _plan(self) -> list[Waypoint]:
        env = self._env
        pick = env.object_pose(self._picked)[:3]
        pick[2] = max(pick[2], LOWEST_GRASP)
        if self._outcome == "never_touch":
            pick[2] += 0.08
        place = np.array([*env.goal, pick[2]])
        above, over = pick + [0, 0, CLEARANCE], place + [0, 0, CLEARANCE]
        deepest = np.array([*env.goal, max(pick[2] - TOUCHDOWN_DEPTH, LOWEST_PLACE)])
        middle = 0.5 * (above + over)
        # Closed on air the pads would touch each other, which is no absence of touch.
        closed = 0.03 if self._outcome == "never_touch" else 0.0
        carried = GRIPPER_MAX_WIDTH if self._outcome == "drop" else closed
        waypoints = [
            Waypoint("approach", above, GRIPPER_MAX_WIDTH, 1.0),
            Waypoint("descend", pick, GRIPPER_MAX_WIDTH, 0.7),
            Waypoint("close", None, closed, 0.8),
            Waypoint("lift", above, closed, 0.7),
            Waypoint("carry", middle, closed, 0.6),
            Waypoint("carry", over, carried, 0.6),
            Waypoint("lower", place + [0, 0, 0.004], carried, 0.9, until_supported=True),
            Waypoint("touch down", deepest, carried, 0.8, until_supported=True),
            Waypoint("hold", None, carried, 0.8),
        ]
        if env.config.release:
            waypoints[-1:] = [
                Waypoint("release", None, GRIPPER_MAX_WIDTH, 0.5),
                Waypoint("retreat", over, GRIPPER_MAX_WIDTH, 0.8),
            ]
        return waypoints

    @property
    def _picked(self) -> str:
        return "distractor_1" if self._outcome == "wrong_object" else "object"

    def _freeze_tick(self) -> float:
        if self._outcome != "freeze":
            return np.inf
        return float(self._env.np_random.integers(15, 85))

    def _yaw_now(self) -> float:
        _, R = self._env.kinematics.forward(self._env.command)
        return float(np.arctan2(R[1, 0], R[0, 0]))

    def _towards(self, position: np.ndarray, yaw: float, width: float) -> np.ndarray:
        env = self._env
        joints = env.kinematics.solve_ik(position, fingers_down(yaw), env.command)
        return np.append(joints - env.command, width)


def _minimum_jerk(s: float) -> float:
    """Return the share of a rest-to-rest move at a share of its time (Flash and Hogan, 1985)."""
    return s**3 * (10 - 15 * s + 6 * s * s)

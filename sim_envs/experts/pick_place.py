"""A scripted demonstrator with ground truth, which can also fail on purpose."""

from collections.abc import Iterator
from typing import get_args

import numpy as np

from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.rotations import fingers_down
from touchgoal.runtime.errors import UserError, unknown_name
from touchgoal.sim_envs.cell.hardware import GRIPPER_MAX_WIDTH
from touchgoal.sim_envs.config import Outcome
from touchgoal.sim_envs.experts.pick_place_plans import (
    LONGEST_PLAN,
    PLANS,
    SLIDE,
    Plan,
    picked_body,
)
from touchgoal.sim_envs.pick_place import PickPlace

OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)


class PickPlaceExpert(Actor):
    """Picks and places, or does what `outcome` says (`touchgoal.sim_envs.config.Outcome`)."""

    def __init__(self, env: PickPlace, outcome: Outcome = "success") -> None:
        """Plan an episode right after its reset.

        UserError: no such outcome, or one that this scene or time limit does not allow.
        """
        _check(env, outcome)
        self._env, self._picked = env, picked_body(outcome)
        self._actions = self._follow(PLANS[outcome](env))

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next action, from ground truth; no motion once the plan is over."""
        return next(self._actions)

    def _follow(self, plan: Plan) -> Iterator[np.ndarray]:
        env = self._env
        position, R = env.kinematics.forward(env.command)
        yaw, target_yaw = float(np.arctan2(R[1, 0], R[0, 0])), env.grasp_yaw(self._picked)
        width = GRIPPER_MAX_WIDTH
        for waypoint in plan:
            ticks = round(waypoint.seconds * env.config.control_hz)
            start, start_yaw, width = position, yaw, waypoint.width
            held_at = self._height_in_hand()
            env.grasp_force = waypoint.force or env.grasp_force
            for k in range(1, round(waypoint.share * ticks) + 1):
                if waypoint.until == "supported" and env.object_on_table(self._picked):
                    # Command what is, not what was asked: the lag would press on the table.
                    position = env.data.site("tcp").xpos.copy()
                    break
                if waypoint.until == "slid" and held_at - self._height_in_hand() > SLIDE:
                    break
                s = _minimum_jerk(k / ticks)
                if waypoint.position is not None:
                    position = start + s * (waypoint.position - start)
                yaw = start_yaw + s * (target_yaw - start_yaw)
                joints = env.kinematics.solve_ik(position, fingers_down(yaw), env.command)
                yield np.append(joints - env.command, width)
        while True:
            yield np.append(np.zeros(env.n_joints), width)

    def _height_in_hand(self) -> float:
        """Return the height of the object above the TCP, m."""
        return float(self._env.object_pose(self._picked)[2] - self._env.data.site("tcp").xpos[2])


def _check(env: PickPlace, outcome: Outcome) -> None:
    if outcome not in OUTCOMES:
        raise unknown_name("outcome", outcome, OUTCOMES)
    if outcome == "wrong_object" and len(env.bodies) < 2:
        raise UserError("outcome wrong_object needs a second object; set distractors to 1")
    if outcome == "same_shape" and env.asked == env.bodies[0].kind.name:
        raise UserError("outcome same_shape needs reset's option `asked`, the object asked for")
    if outcome in ("slow", "regrasped") and env.config.max_seconds < LONGEST_PLAN:
        raise UserError(
            f"outcome {outcome} takes up to {LONGEST_PLAN:g} s: set max_seconds to {LONGEST_PLAN:g}"
        )


def _minimum_jerk(s: float) -> float:
    """Return the share of a rest-to-rest move at a share of its time (Flash and Hogan, 1985)."""
    return s**3 * (10 - 15 * s + 6 * s * s)

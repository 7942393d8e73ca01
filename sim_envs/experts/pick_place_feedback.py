"""A pick-and-place expert that acts on the current state alone, to correct a policy anywhere."""

import numpy as np
from jaxtyping import Float

from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.rotations import fingers_down, rotation_matrix, rotation_vector
from touchgoal.sim_envs.cell.hardware import GRIPPER_MAX_WIDTH
from touchgoal.sim_envs.experts import pick_place_plans
from touchgoal.sim_envs.pick_place import PickPlace

_STEEP = 3.0  # m of height per m that the hand is beside its place
_NEAR, _GRIPPING = 0.006, 0.015  # m beside the object within which fingers begin, go on to close
_OVER, _PLACED = 0.008, 0.014  # m beside the goal within which the object is lowered, stays down
_PLACING = 3.0  # N, upwards on the hand, with which an object is held down where it is placed
_NOTICEABLE = 1.0  # N that an arm measures reliably
_BEGUN = GRIPPER_MAX_WIDTH - 0.006  # m of width below which the fingers have begun to close
_STILL = 0.006  # m/s of width: fingers that something stops
_SPEED, _CLIMB, _TOUCHDOWN = 0.3, 0.2, 0.01  # m/s: at most over the table, up and down, near it
_CLOSE = 0.012  # m above its place below which the object is lowered at `_TOUCHDOWN` at most
_PRESS = 5.0  # N, upwards on the hand, above which it gives way
# m/s per N: slow enough for a hand that feels the table (about 10 N/mm) 0.15 s late not to bounce
_GIVE, _FASTEST_GIVE = 4e-4, 0.02
_ACCELERATION = 4.0  # m/s^2
_RETURN, _LOWER = 5.0, 3.0  # 1/s: speed towards a place per distance to it; down, with the object
_TURN = 1.0  # rad/s


class FeedbackExpert(Actor):
    """Picks and places from any state of arm and object.

    It follows a funnel over the object, then over the goal: the farther to the side, the higher. It acts
    on the start of the episode and the sensed state of this tick and the last, as a policy can. It
    yields to contact, does not follow a displaced object, and never lets go.
    """

    def __init__(
        self,
        env: PickPlace,
        object_error: Float[np.ndarray, "3"] | float = 0.0,
        goal_error: Float[np.ndarray, "3"] | float = 0.0,
    ) -> None:
        """Begin an episode right after its reset; by `object_error` and `goal_error` (m) it errs."""
        self._env = env
        self._object, self._yaw = env.object_pose()[:3].copy(), env.grasp_yaw()
        self._object[2] = max(self._object[2], pick_place_plans.LOWEST_GRASP)
        self._goal = np.array([*env.goal, self._object[2]])
        self._object += object_error
        self._goal += goal_error
        self._before, _ = env.kinematics.forward(env.command)
        self._width = env.width()

    def act(self, observation: Observation) -> Float[np.ndarray, " n"]:
        """Return the next action, from ground truth; call it at every tick."""
        env, hz = self._env, self._env.config.control_hz
        (here, R), width = env.kinematics.forward(env.command), env.width()
        pace = (here - self._before) * hz
        still = abs(width - self._width) * hz < _STILL
        self._before, self._width = here, width
        yaw = float(np.arctan2(R[1, 0], R[0, 0]))
        turn, grip = 0.0, 0.0
        if still and all(pad.touching for pad in env.pad_contacts()):
            velocity = self._carry(here)
        else:
            turn = float((self._yaw - yaw + np.pi / 2) % np.pi - np.pi / 2)
            velocity, turn, grip = self._fetch(here, turn, width)
        pressed = max(0.0, float(env.external_wrench()[2]) - _PRESS)
        velocity[2] += min(_GIVE * pressed, _FASTEST_GIVE)
        change = velocity - pace
        change *= min(1.0, _ACCELERATION / hz / max(float(np.linalg.norm(change)), 1e-9))
        turn = float(np.clip(_RETURN * turn, -_TURN, _TURN)) / hz
        # A policy may have led the arm to where nothing is in reach: the nearest place will do.
        solution = env.kinematics.solve_ik_near(
            here + (pace + change) / hz, _righted(R, yaw, turn, _RETURN / hz), env.command
        )
        delta = solution.q - env.command
        if env.max_joint_step is not None:  # slow the whole motion: clamping single joints bends it
            delta *= min(1.0, float((env.max_joint_step / np.maximum(np.abs(delta), 1e-9)).min()))
        return np.append(delta, grip)

    def _fetch(
        self, here: np.ndarray, turn: float, width: float
    ) -> tuple[np.ndarray, float, float]:
        """Return velocity (m/s), remaining turn (rad) and width (m) of a hand that holds nothing."""
        off = self._object - here
        beside = float(np.linalg.norm(off[:2])) + 0.05 * abs(turn)
        reach = _GRIPPING if width < _BEGUN else _NEAR
        if beside < reach and abs(off[2]) < reach:
            return np.zeros(3), 0.0, 0.0
        return _funnel(off, beside - _NEAR), turn, GRIPPER_MAX_WIDTH

    def _carry(self, here: np.ndarray) -> np.ndarray:
        off = self._goal - here
        beside = float(np.linalg.norm(off[:2]))
        force = float(self._env.external_wrench()[2])
        if beside < (_PLACED if force > _NOTICEABLE else _OVER) and off[2] > -_CLOSE:
            deepest = max(
                self._goal[2] - pick_place_plans.TOUCHDOWN_DEPTH, pick_place_plans.LOWEST_PLACE
            )
            lower = np.clip(1 - force / _PLACING, 0, 1) * (here[2] > deepest)
            return np.array([0, 0, -_TOUCHDOWN * lower])
        return _funnel(off, beside - _OVER, _LOWER)


def _righted(
    R: Float[np.ndarray, "3 3"], yaw: float, turn: float, share: float
) -> Float[np.ndarray, "3 3"]:
    """Return the hand turned by `turn` (rad), with `share` of its tilt removed."""
    tilt = rotation_vector(fingers_down(yaw).T @ R)
    return fingers_down(yaw + turn) @ rotation_matrix((1 - share) * tilt)


def _funnel(off: np.ndarray, beside: float, lower: float = _RETURN) -> np.ndarray:
    """Return the velocity (m/s) towards a place `off` (m) from above it."""
    rise = off[2] + min(pick_place_plans.CLEARANCE, _STEEP * max(0.0, beside))
    distance = float(np.linalg.norm(off[:2]))
    high = np.clip(1 - rise / 0.04, 0, 1)  # over the table only where it is high enough
    climb = np.clip((_RETURN if rise > 0 else lower) * rise, -_CLIMB, _CLIMB)
    return np.array([*(off[:2] * high * min(_RETURN, _SPEED / max(distance, 1e-9))), climb])

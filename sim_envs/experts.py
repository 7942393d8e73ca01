"""Scripted demonstrators that know where everything is, and can be asked to fail."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from touchgoal.control.errors import UserError
from touchgoal.control.kinematics import fingers_down
from touchgoal.sim_envs.base import GRIPPER_MAX_WIDTH, Observation
from touchgoal.sim_envs.pick_place import PickPlace

Outcome = Literal["success", "never_touch", "drop", "wrong_object", "freeze"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)

_CLEARANCE = 0.12  # m above the object before and after the grasp
_LOWEST_GRASP = 0.0185  # m: the sensor case (32.5 mm) must stay above the table
_LOWEST_PLACE = 0.0172
_FEEL_DOWN = 0.010  # m below the grasp's height to look for the table when placing
_ACCELERATION = 1.5  # m/s^2
_RETURN = 8.0  # 1/s: greatest speed towards a place per distance to it
_THERE = 0.003  # m from the place at which a move is over
_TURN = 1.5  # rad/s
_HOLD = 3


@dataclass(frozen=True)
class Segment:
    """A move of the TCP, fingers down, while the gripper goes to `width`.

    Attributes:
        position: of the TCP at the end, m, base frame; None: stay.
        width: gripper target throughout, m.
        speed: at most, m/s.
        seconds: that it lasts, or at most if it is a move.
        until_supported: end early once the table carries the object.
        until_held: end early once both pads have touched something for `_HOLD` ticks.
    """

    name: str
    position: np.ndarray | None
    width: float
    seconds: float
    speed: float = 0.0
    until_supported: bool = False
    until_held: bool = False


class PickPlaceExpert:
    """Picks and places, or fails in the way `outcome` asks for.

    never_touch closes the hand 8 cm above the object; drop lets go on the way; wrong_object takes
    the first distractor; freeze stops moving somewhere between the start and the goal.

    A move heads for its end from wherever the hand has been led astray.
    """

    def __init__(self, env: PickPlace, outcome: Outcome = "success") -> None:
        if outcome not in OUTCOMES:
            raise UserError(f"unknown outcome {outcome!r}; choose from: {', '.join(OUTCOMES)}")
        if outcome == "wrong_object" and len(env.bodies) < 2:
            raise UserError("outcome wrong_object needs a second object; set distractors to 1")
        self._env, self._outcome = env, outcome
        self._actions = self._run()

    def act(self, observation: Observation) -> np.ndarray:
        """The action for the next tick; stands still once the plan is over.

        The observation is not looked at: the expert sees the simulator's state.
        """
        return next(self._actions)

    def _run(self) -> Iterator[np.ndarray]:
        env, hz = self._env, self._env.config.control_hz
        yaw, stop = env.grasp_yaw(self._picked), self._freeze_tick()
        velocity = np.zeros(3)
        tick, held, width = 0, 0, GRIPPER_MAX_WIDTH
        for segment in self._plan():
            for _ in range(round(segment.seconds * hz)):
                here, R = env.kinematics.forward(env.command)
                held = held + 1 if all(pad.touching for pad in env.pad_contacts()) else 0
                if segment.until_supported and env.object_on_table(self._picked):
                    break
                if segment.until_held and held >= _HOLD:
                    break
                target = here if segment.position is None else segment.position
                if segment.position is not None and _distance(target, here) < _THERE:
                    break
                tick += 1
                if tick > stop:
                    break
                velocity = self._velocity(target - here, velocity, segment.speed)
                turn = np.clip(yaw - np.arctan2(R[1, 0], R[0, 0]), -_TURN / hz, _TURN / hz)
                turned = np.arctan2(R[1, 0], R[0, 0]) + turn
                yield self._towards(here + velocity / hz, turned, segment.width)
            if tick > stop:
                break
            width = segment.width
        while True:
            yield np.append(np.zeros(env.n_joints), width)

    def _velocity(self, way: np.ndarray, before: np.ndarray, most: float) -> np.ndarray:
        """Velocity (m/s) of the next tick on the way (m) to a place, given the last tick's."""
        distance = float(np.linalg.norm(way))
        speed = min(most, np.sqrt(2 * _ACCELERATION * distance), _RETURN * distance)
        change = way / max(distance, 1e-9) * speed - before
        greatest = _ACCELERATION / self._env.config.control_hz
        return before + change * min(1.0, greatest / max(float(np.linalg.norm(change)), 1e-9))

    def _plan(self) -> list[Segment]:
        env = self._env
        pick = env.object_pose(self._picked)[:3]
        pick[2] = max(pick[2], _LOWEST_GRASP)
        if self._outcome == "never_touch":
            pick[2] += 0.08
        place = np.array([*env.goal, pick[2]])
        above, over = pick + [0, 0, _CLEARANCE], place + [0, 0, _CLEARANCE]
        deepest = np.array([*env.goal, max(pick[2] - _FEEL_DOWN, _LOWEST_PLACE)])
        # Closed on air the pads would touch each other, which is no absence of touch.
        closed = 0.03 if self._outcome == "never_touch" else 0.0
        segments = [
            Segment("approach", above, GRIPPER_MAX_WIDTH, 2.0, speed=0.4),
            Segment("descend", pick, GRIPPER_MAX_WIDTH, 1.5, speed=0.25),
            Segment("close", None, closed, 0.7, until_held=True),
            Segment("lift", above, closed, 1.5, speed=0.25),
        ]
        if self._outcome == "drop":
            segments.append(Segment("carry", 0.5 * (above + over), closed, 1.5, speed=0.4))
            closed = GRIPPER_MAX_WIDTH
        segments += [
            Segment("carry", over, closed, 2.0, speed=0.4),
            Segment("lower", place + [0, 0, 0.004], closed, 1.5, 0.25, until_supported=True),
            Segment("feel", deepest, closed, 1.0, 0.02, until_supported=True),
            Segment("hold", None, closed, 0.8),
        ]
        if env.config.release:
            segments[-1:] = [
                Segment("release", None, GRIPPER_MAX_WIDTH, 0.5),
                Segment("retreat", over, GRIPPER_MAX_WIDTH, 1.5, speed=0.25),
            ]
        return segments

    @property
    def _picked(self) -> str:
        return "distractor_1" if self._outcome == "wrong_object" else "object"

    def _freeze_tick(self) -> float:
        """When to stand still for good: on the way to the object or with it, as the seed says."""
        if self._outcome != "freeze":
            return np.inf
        return float(self._env.np_random.integers(15, 60))

    def _towards(self, position: np.ndarray, yaw: float, width: float) -> np.ndarray:
        env = self._env
        joints = env.kinematics.reach(position, fingers_down(yaw), env.command)
        return np.append(joints - env.command, width)


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b))

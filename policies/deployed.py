"""Who acts on a cell: the expert with known positions, the follower, or a policy on disk."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.deployment.control_loop import DeployedActor
from touchgoal.control.deployment.realtime import ChunkPlanner, RealTimeActor
from touchgoal.control.deployment.scripted import PickPlacePoses, pick_and_place
from touchgoal.control.features import Observation
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import RobotLimits
from touchgoal.policies.by_name import UserPolicy, find_user_policy
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, SavedPolicy, find_policy
from touchgoal.policies.follower import WireFollower
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.servo_lag import ServoLag
from touchgoal.sim_envs.twin.in_process import env_config_of

_SIMULATED_PLAN_TIMEOUT = 20.0  # s for which a simulated arm's time stands still for a plan


class FollowerActor:
    """The wire follower in the loop; it never ends by itself."""

    done, action_age = False, 0.0

    def __init__(self, hz: int) -> None:
        self._follower = WireFollower(hz)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See DeployedActor."""
        return self._follower.act(observation)

    def close(self) -> None:
        """Nothing is left behind."""


class LearnedActor(RealTimeActor):
    """A policy's plans in the loop; it never ends by itself.

    It has learned on an arm whose servo follows with a lag. One that follows at once answers its
    corrections too soon, and in contact the two then shake each other: so the lag is put back. What
    was wanted and has not been passed on yet counts as commanded.
    """

    done = False

    def __init__(
        self, planner: ChunkPlanner, robot: RobotLimits, timeout: float | None = None
    ) -> None:
        """For the robot that acts; see RealTimeActor."""
        super().__init__(planner, timeout)
        self._hz = planner.config.control_hz
        self._lag = ServoLag(robot, 1 / self._hz)
        self._before: np.ndarray | None = None  # joints (rad) wanted at the last tick

    def act(self, observation: Observation) -> np.ndarray:
        """See DeployedActor."""
        action = super().act({**observation, ft.COMMAND: self._wanted(observation)})
        return np.append(self._lag.update(action[:-1]), action[-1])

    def _wanted(self, observation: Observation) -> Float32[np.ndarray, "14"]:
        """`features.COMMAND` with what has not been passed on yet."""
        q = observation[ft.COMMAND][: ft.N_JOINTS] + self._lag.remaining
        velocity = (q - (q if self._before is None else self._before)) * self._hz
        self._before = q
        return np.concatenate([q, velocity]).astype(np.float32)


@dataclass(frozen=True)
class _EveryTick:
    """Horizons of what answers every tick anew."""

    observation_horizon: int = 1
    execution_horizon: int = 1
    control_hz: int = ft.CONTROL_HZ


class UserPolicyPlanner:
    """A policy of one's own as plans of one tick, so that the loop never waits for a slow one."""

    config = _EveryTick()
    ticks_seen = 1

    def __init__(self, policy: UserPolicy) -> None:
        self._policy = policy

    def embed(self, seen: Sequence[Observation]) -> None:
        """Nothing is embedded ahead."""

    def plan(self, seen: Sequence[Observation]) -> Float32[np.ndarray, "1 8"]:
        """The action for the next tick; UserError if it has another shape."""
        action = np.asarray(self._policy.act(dict(seen[-1])), np.float32)
        if action.shape != (ft.N_JOINTS + 1,):
            raise UserError(
                f"the policy's action has the shape {action.shape}: give {ft.N_JOINTS} joint changes "
                "(rad) and the gripper's width (m)"
            )
        return action[None]


@dataclass(frozen=True)
class CellPolicy:
    """A learned policy that fits the cell, loaded for one run: its planner, and the size (rows,
    columns) of the cameras' pictures that it looks at."""

    planner: ChunkPlanner
    camera_size: tuple[int, int]


def load_cell_policy(cell: CellConfig) -> CellPolicy | None:
    """The cell's policy on disk or of one's own, None of an expert; UserError if it does not fit."""
    if cell.task.policy in ("expert", "follower"):
        return None
    if cell.arm == "ur5e":
        raise UserError("the policy commands the seven joints of an FR3, not a UR5e's: use expert")
    # Cameras send larger pictures than are recorded and, if a policy asks for nothing else, observed.
    task = replace(env_config_of(cell), camera_size=ft.CAMERA_SHAPE[:2])
    if (found := find_user_policy(cell.task.policy)) is not None:
        planner, needed = UserPolicyPlanner(found()), found.env_config(task)
    else:
        shipped = cell.task.policy == "shipped"
        directory = SHIPPED_POLICIES[cell.task.name] if shipped else find_policy(cell.task.policy)
        planner, needed = SavedPolicy(directory).planner_for(task)
    if needed.tactile and cell.fingertips is None:
        raise UserError("the policy feels with fingertips, the cell has none: add [fingertips]")
    for camera in needed.cameras:
        if camera not in cell.cameras:
            raise UserError(f"the policy looks at the {camera} camera: add [cameras.{camera}]")
    return CellPolicy(planner, needed.camera_size)


def pick_place_poses(
    cell: CellConfig, truth: Callable[[], dict[str, Any]] | None
) -> PickPlacePoses:
    """Where the expert's object and goal are: as the cell says, else as the simulator knows."""
    task = cell.task
    if task.grasp and task.goal:
        return PickPlacePoses(task.grasp, task.goal)
    if truth is None:
        raise UserError("task.grasp and task.goal are missing: measure where they are, in metres")
    layout = truth()["layout"]
    return PickPlacePoses(tuple(layout["grasp"]), tuple(layout["goal"]))


def make_actor(
    cell: CellConfig,
    policy: CellPolicy | None,
    safety: ActionFilter,
    truth: Callable[[], dict[str, Any]] | None,
    commanded: Callable[[], np.ndarray],
) -> DeployedActor:
    """The actor for one run, from where the arm is now."""
    if policy is not None:
        # So a run on a simulated arm repeats on any machine.
        timeout = _SIMULATED_PLAN_TIMEOUT if cell.time_waits else None
        return LearnedActor(policy.planner, safety.limits, timeout)
    if cell.task.policy == "follower":
        return FollowerActor(ft.CONTROL_HZ)
    return pick_and_place(pick_place_poses(cell, truth), safety, commanded)

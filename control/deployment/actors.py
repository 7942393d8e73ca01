"""The actor that a cell file's `task.policy` names."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.deployment.realtime import ChunkPlanner, RealTimeActor
from touchgoal.control.deployment.scripted import PickPlacePoses, pick_and_place
from touchgoal.control.deployment.user_policy import find_user_policy
from touchgoal.control.interfaces import Actor
from touchgoal.control.motion.tracker import ServoLag
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.teleoperation.yielding_actor import YieldingActor
from touchgoal.runtime.errors import UserError

_SIMULATED_PLAN_TIMEOUT = 20.0  # s of wall time that a simulated arm waits for a plan
SCRIPTED = ("expert", "follower")  # names of the actors without a policy


@runtime_checkable
class PolicyNeeds(Protocol):
    """The options of an environment that say what a policy observes."""

    @property
    def tactile(self) -> bool: ...  # noqa: D102
    @property
    def cameras(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def camera_size(self) -> tuple[int, int]: ...  # noqa: D102


@dataclass(frozen=True)
class DeployedPolicy:
    """A policy that fits a cell, loaded for one run; it sees camera images of (rows, columns)."""

    planner: ChunkPlanner
    camera_size: tuple[int, int]

    @classmethod
    def for_cell(
        cls, cell: CellConfig, planner: ChunkPlanner, needs: PolicyNeeds
    ) -> "DeployedPolicy":
        """Return the policy; UserError if the cell lacks a sensor that it needs."""
        if cell.arm == "ur5e":
            raise UserError(
                "the policy commands the seven joints of an FR3, not a UR5e's: use expert"
            )
        if needs.tactile and cell.fingertips is None:
            raise UserError("the policy feels with fingertips, the cell has none: add [fingertips]")
        for camera in needs.cameras:
            if camera not in cell.cameras:
                raise UserError(f"the policy looks at the {camera} camera: add [cameras.{camera}]")
        return cls(planner, needs.camera_size)


def load_user_policy(cell: CellConfig, options: PolicyNeeds) -> DeployedPolicy | None:
    """Return the cell's policy if it is a user's class or server; UserError if it does not fit.

    It may change the `options` of its environment.
    """
    if (found := find_user_policy(cell.task.policy, cell.task.instruction)) is None:
        return None
    return DeployedPolicy.for_cell(cell, found(), found.env_config(options))


def make_actor(
    cell: CellConfig,
    policy: DeployedPolicy | None,
    safety: ActionFilter,
    truth: Callable[[], dict[str, Any]] | None,
    commanded: Callable[[], np.ndarray],
) -> Actor:
    """Return the actor for one run, from where the arm is now."""
    if policy is not None:
        # Waiting makes a run on a simulated arm repeatable on any machine.
        timeout = _SIMULATED_PLAN_TIMEOUT if cell.time_waits else None
        if cell.task.own:  # its demonstrations were led without that lag, by a hand that yields
            return YieldingActor(RealTimeActor(policy.planner, timeout), safety, commanded)
        return RealTimeActor(policy.planner, timeout, ServoLag(safety.limits, safety.dt))
    if cell.task.policy == "follower":
        return WireFollower(ft.CONTROL_HZ)
    return pick_and_place(_pick_place_poses(cell, truth), safety, commanded)


def _pick_place_poses(
    cell: CellConfig, truth: Callable[[], dict[str, Any]] | None
) -> PickPlacePoses:
    """Return the expert's grasp and goal from the cell file, else from the simulator."""
    task = cell.task
    if task.grasp and task.goal:
        return PickPlacePoses(task.grasp, task.goal)
    if truth is None:
        raise UserError("task.grasp and task.goal are missing: measure where they are, in metres")
    layout = truth()["layout"]
    return PickPlacePoses(tuple(layout["grasp"]), tuple(layout["goal"]))

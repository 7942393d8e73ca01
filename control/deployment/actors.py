"""The actor that a cell file's `task.policy` names."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.control.deployment.scripted import PickPlacePoses, pick_and_place
from touchgoal.control.interfaces import Actor, Planner
from touchgoal.control.motion.tracker import ServoLag
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.teleoperation.teleoperator import YieldingHand
from touchgoal.runtime.errors import UserError

_SIMULATED_PLAN_TIMEOUT = 20.0  # s of wall time that a simulated arm waits for a plan
SCRIPTED = ("expert", "follower")  # names of the actors without a policy


def check_sensors(cell: CellConfig, tactile: bool, cameras: Sequence[str]) -> None:
    """Raise UserError if a policy cannot command the cell's arm, or the cell lacks a sensor it reads."""
    if cell.arm == "ur5e":
        raise UserError("the policy commands the seven joints of an FR3, not a UR5e's: use expert")
    if tactile and cell.fingertips is None:
        raise UserError("the policy feels with fingertips, the cell has none: add [fingertips]")
    for camera in cameras:
        if camera not in cell.cameras:
            raise UserError(f"the policy looks at the {camera} camera: add [cameras.{camera}]")


def make_actor(
    cell: CellConfig,
    policy: Planner | None,
    safety: ActionFilter,
    truth: Callable[[], dict[str, Any]] | None,
    commanded: Callable[[], np.ndarray],
) -> Actor:
    """Return the actor for one run, from where the arm is now; without a policy the cell's script.

    The expert's grasp and goal are the cell file's, else the simulator's.
    """
    if policy is not None:
        # Waiting makes a run on a simulated arm repeatable on any machine.
        timeout = _SIMULATED_PLAN_TIMEOUT if cell.time_waits else None
        if cell.task.own:  # its demonstrations were led without that lag, by a hand that yields
            return RealTimeActor(policy, timeout, hand=YieldingHand(safety, commanded))
        return RealTimeActor(policy, timeout, ServoLag(safety.limits, safety.dt))
    if cell.task.policy == "follower":
        return WireFollower(ft.CONTROL_HZ)
    grasp, goal = cell.task.grasp, cell.task.goal
    if not (grasp and goal):
        if truth is None:
            raise UserError(
                "task.grasp and task.goal are missing: measure where they are, in metres"
            )
        layout = truth()["layout"]
        grasp, goal = tuple(layout["grasp"]), tuple(layout["goal"])
    return pick_and_place(PickPlacePoses(grasp, goal), safety, commanded)

"""Who acts on a rig: the expert with known positions, the follower, or a policy on disk."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import Rig
from touchgoal.control.errors import UserError
from touchgoal.control.safety.action_filter import Safety
from touchgoal.policies.acting import SHIPPED, ActorMaker, Observation
from touchgoal.policies.deploy.control_loop import DeployedActor
from touchgoal.policies.deploy.realtime import Plans, RealTimeActor
from touchgoal.policies.deploy.scripted import Place, pick_and_place
from touchgoal.policies.follower import WireFollower
from touchgoal.sim_envs.scene.build import SERVO_DAMPING
from touchgoal.sim_envs.twin.in_process import task_of

_STANDS_STILL = 20.0  # s for which a simulated arm's time stands still for a plan


class Follower:
    """The wire follower in the loop; it never ends by itself."""

    done, overdue = False, 0.0

    def __init__(self, hz: int) -> None:
        self._follower = WireFollower(hz)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """See DeployedActor."""
        return self._follower.act(observation)

    def close(self) -> None:
        """Nothing is left behind."""


class Learned(RealTimeActor):
    """A policy's plans in the loop; it never ends by itself.

    It has learned on an arm whose servo follows with a lag. One that follows at once answers its
    corrections too soon, and in contact the two then shake each other: so the lag is put back.
    """

    done = False

    def __init__(self, planner: Plans, patience: float | None = None) -> None:
        """See RealTimeActor."""
        super().__init__(planner, patience)
        self._share = 1 - float(np.exp(-1 / (planner.config.control_hz * SERVO_DAMPING)))
        self._left = np.zeros(ft.N_JOINTS)  # rad, wanted and not yet passed on

    def act(self, observation: Observation) -> np.ndarray:
        """See DeployedActor."""
        action = super().act(observation)
        self._left = self._left + action[:-1]
        step = self._share * self._left
        self._left = self._left - step
        return np.append(step, action[-1])


def learned(rig: Rig) -> ActorMaker | None:
    """The rig's policy on disk, None of an expert; UserError if it does not fit the rig."""
    if rig.task.policy in ("expert", "follower"):
        return None
    shipped = rig.task.policy == "shipped"
    directory = SHIPPED[rig.task.name] if shipped else Path(rig.task.policy)
    task = task_of(rig)
    maker = ActorMaker(directory).checked(task)
    if rig.arm == "ur5e":
        raise UserError("the policy commands the seven joints of an FR3, not a UR5e's: use expert")
    needed = maker.observing(task)
    if needed.tactile and rig.fingertips is None:
        raise UserError("the policy feels with fingertips, the rig has none: add [fingertips]")
    for camera in needed.cameras:
        if camera not in rig.cameras:
            raise UserError(f"the policy looks at the {camera} camera: add [cameras.{camera}]")
    return maker


def place_of(rig: Rig, truth: Callable[[], dict[str, Any]] | None) -> Place:
    """Where the expert's object and goal are: as the rig says, else as the simulator knows."""
    task = rig.task
    if task.grasp and task.goal:
        return Place(task.grasp, task.goal)
    if truth is None:
        raise UserError("task.grasp and task.goal are missing: measure where they are, in metres")
    layout = truth()["layout"]
    return Place(tuple(layout["grasp"]), tuple(layout["goal"]))


def make_actor(
    rig: Rig,
    maker: ActorMaker | None,
    safety: Safety,
    truth: Callable[[], dict[str, Any]] | None,
    commanded: Callable[[], np.ndarray],
) -> DeployedActor:
    """The actor for one run, from where the arm is now."""
    if maker is not None:
        # So a run on a simulated arm repeats on any machine.
        return Learned(maker.planner(), _STANDS_STILL if rig.arm == "sim" else None)
    if rig.task.policy == "follower":
        return Follower(ft.CONTROL_HZ)
    return pick_and_place(place_of(rig, truth), safety, commanded)

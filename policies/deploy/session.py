"""One deployment from the start move to the episode on disk."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import Rig
from touchgoal.control.cell.connection import Station
from touchgoal.control.errors import UserError
from touchgoal.control.safety.action_filter import Safety
from touchgoal.episodes.schema import Episode, MetaValue
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.policies.deploy.control_loop import DeployedActor, Deployment, Ending, Ticks, View
from touchgoal.policies.deploy.scripted import start_move
from touchgoal.sim_envs.base import Observation

_AT_START = 0.02  # rad from the start pose after the start move
_NEAR = 0.1  # rad; nearer than that no start move is made
_SETTLES = 2.0  # s that a simulator may take to see that the task is done

MakeActor = Callable[[Deployment], DeployedActor]


@dataclass(frozen=True)
class Result:
    """What came of it.

    Attributes:
        ending: how the run ended.
        ticks: what was recorded.
        success: the simulator's judgement; None where nobody knows.
        episode: index of the recorded episode; None without one.
        trouble: why there is none, if there should be one.
    """

    ending: Ending
    ticks: Ticks
    success: bool | None
    episode: int | None
    trouble: str = ""


@dataclass(frozen=True)
class Session:
    """What a deployment is made of.

    Attributes:
        execute: False: a dry run, which records nothing.
        make: the actor, when the arm is at its start.
        wanted, show, cost, camera_size: see Deployment.
        truth: what a simulator knows.
    """

    rig: Rig
    station: Station
    safety: Safety
    episodes: Path
    execute: bool
    make: MakeActor
    wanted: Callable[[], str]
    show: Callable[[View], None]
    truth: Callable[[], dict[str, Any]] | None
    cost: Callable[[Observation], float] | None = None
    camera_size: tuple[int, int] = ft.CAMERA_SHAPE[:2]

    def run(self) -> Result:
        """Start move, task, recording; the arm is at rest or holds its last command at the end.

        Raises:
            UserError, DriverError: it cannot even begin; nothing has moved.
        """
        deployment = Deployment(
            self.station,
            self.safety,
            self.execute,
            self.wanted,
            self.show,
            self.cost,
            self.camera_size,
        )
        ticks = Ticks()
        ending = self._to_start(deployment)
        if ending is None:
            ending = self._perform(deployment, ticks)
        success = self._judge(ending)
        episode, trouble = None, ""
        if self.execute and ticks.rows:
            try:
                episode = self._record(ticks, ending, success)
            except (OSError, UserError) as error:
                trouble = f"this episode could not be kept ({error}); those before it are whole"
        return Result(ending, ticks, success, episode, trouble)

    def _to_start(self, deployment: Deployment) -> Ending | None:
        """Why it does not go on; None if the arm is where the task begins."""
        if self.rig.task.start is None:
            return None
        start = np.array(self.rig.task.start)
        if start.shape != deployment.commanded().shape:
            raise UserError(f"task.start has {start.size} joints: this arm has another number")
        if np.abs(start - deployment.commanded()).max() > _NEAR:
            move = start_move(start, deployment.width, self.safety, deployment.commanded)
            ending = deployment.run(move, 60.0, Ticks())
            if not move.done or ending.stopped:
                return ending
            off = float(np.abs(start - deployment.commanded()).max())
            if off > _AT_START:
                return deployment.stop(
                    f"the start pose was missed by {off:.3f} rad",
                    "look for what holds the arm back",
                )
        return None

    def _perform(self, deployment: Deployment, ticks: Ticks) -> Ending:
        actor = self.make(deployment)
        try:
            return deployment.run(actor, self.rig.task.seconds, ticks)
        finally:
            actor.close()

    def _judge(self, ending: Ending) -> bool | None:
        if self.truth is None or not self.execute:
            return None
        clock = self.station.clock
        end = clock.now() + (0.0 if ending.stopped else _SETTLES)
        try:
            while not (success := bool(self.truth()["success"])) and clock.now() < end:
                clock.wait(clock.now() + self.safety.dt)
        except UserError:  # the twin has ended; the ending says so
            return None
        return success

    def _record(self, ticks: Ticks, ending: Ending, success: bool | None) -> int:
        rig = self.rig
        outcome = {True: "success", False: "failure", None: "unknown"}[success]
        meta: dict[str, MetaValue] = {
            "sensor": rig.sensor,
            "arm": rig.arm,
            "policy": rig.task.policy,
            "outcome": "stopped" if ending.stopped else outcome,
            "ending": ending.reason,
        }
        task = rig.task.instruction or rig.task.name
        episode = Episode(frames=ticks.frames(), task=task, meta=meta)
        return EpisodeWriter(self.episodes, fps=ft.CONTROL_HZ).append(episode)

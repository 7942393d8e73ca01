"""One deployment from the start move to the episode on disk."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.deployment.control_loop import (
    ControlLoop,
    Ending,
    Request,
    RunLog,
    TickStatus,
)
from touchgoal.control.deployment.exchanged import Picture, cameras_exchanged
from touchgoal.control.deployment.scripted import start_move
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor, DriverError
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.runtime.errors import UserError

_START_TOLERANCE = 0.02  # rad from the start pose after the start move
_CLOSE_TO_START = 0.1  # rad; nearer than that no start move is made
_SETTLE_TIME = 2.0  # s that a simulator may take to see that the task is done

RecordEpisode = Callable[[dict[str, np.ndarray], str, dict[str, Any]], int]
"""Record frames (key -> (T, ...)), instruction and facts as an episode; return its index."""
MakeActor = Callable[[ControlLoop], Actor]


@dataclass(frozen=True)
class Result:
    """What came of it.

    Attributes:
        ending: how the run ended.
        log: what was recorded.
        success: whether the task is done: by the simulator's truth, or as the ending tells; None
            where nobody knows.
        progress: of the task, in [0, 1], by the simulator's truth; None without one.
        held_width: m, of what the hand still holds; None if nothing.
        episode: index of the recorded episode; None without one.
        recording_error: why there is none, if there should be one.
    """

    ending: Ending
    log: RunLog
    success: bool | None
    progress: float | None
    held_width: float | None
    episode: int | None
    recording_error: str = ""


@dataclass(frozen=True)
class Session:
    """What a deployment is made of.

    Attributes:
        record: keeps the episode.
        execute: False: a dry run, which records nothing.
        make_actor: the actor, when the arm is at its start.
        operator_request, on_tick, cost, camera_size: see ControlLoop.
        truth: what a simulator knows.
    """

    cell: CellConfig
    connection: CellConnection
    safety: ActionFilter
    record: RecordEpisode
    execute: bool
    make_actor: MakeActor
    operator_request: Callable[[], Request]
    on_tick: Callable[[TickStatus], None]
    truth: Callable[[], dict[str, Any]] | None
    cost: Callable[[Observation], float] | None = None
    camera_size: tuple[int, int] = ft.CAMERA_SHAPE[:2]

    def run(self) -> Result:
        """Start move, task, recording; the arm is at rest or holds its last command at the end.

        Raises:
            UserError, DriverError: it cannot even begin; nothing has moved.
        """
        loop = ControlLoop(
            self.connection,
            self.safety,
            self.execute,
            self.operator_request,
            self.on_tick,
            self.cost,
            self.camera_size,
        )
        log = RunLog()
        ending = self._move_to_start(loop)
        if ending is None:
            ending = self._run_actor(loop, log)
        success = self._success(ending)
        episode, recording_error = None, ""
        if self.execute and log.rows:
            try:
                episode = self._recorded(log, ending, success)
            except (OSError, UserError, MemoryError) as error:
                recording_error = (
                    f"this episode could not be kept ({error}); those before it are whole"
                )
        return Result(
            ending,
            log,
            success,
            self._progress(),
            self._held_width(),
            episode,
            recording_error,
        )

    def _move_to_start(self, loop: ControlLoop) -> Ending | None:
        """Why it does not go on; None if the arm is where the task begins."""
        if self.cell.task.start is None:
            return None
        start = np.array(self.cell.task.start)
        if np.abs(start - loop.commanded()).max() > _CLOSE_TO_START:
            move = start_move(start, loop.width, self.safety, loop.commanded)
            before = self._views()
            ending = loop.run(move, 60.0, RunLog())
            if not move.done or ending.stopped:
                return ending
            off = float(np.abs(start - loop.commanded()).max())
            if off > _START_TOLERANCE:
                return loop.stop(
                    f"the start pose was missed by {off:.3f} rad",
                    "look for what holds the arm back",
                )
            views = [(view, self._views()[key]) for key, view in before.items()]
            if len(views) == len(ft.CAMERAS) and cameras_exchanged(*views):
                return loop.stop(
                    "the front and the wrist camera look exchanged: what is called front moves with the arm",
                    "exchange cameras.front and cameras.wrist in the cell file",
                )
        return None

    def _views(self) -> dict[str, Picture]:
        """What front and wrist camera show now, in this order, of those that there are."""
        cameras = self.connection.cameras
        return {key: cameras[key].read().image for key in ft.CAMERAS if key in cameras}

    def _run_actor(self, loop: ControlLoop, log: RunLog) -> Ending:
        actor = self.make_actor(loop)
        try:
            return loop.run(actor, self.cell.task.seconds, log)
        finally:
            actor.close()

    def _success(self, ending: Ending) -> bool | None:
        """Of a run that was stopped it is False, whatever the task looks like."""
        if not self.execute:
            return None
        if ending.stopped or self.truth is None:
            return ending.done
        clock = self.connection.clock
        end = clock.now() + _SETTLE_TIME
        try:
            while not (success := bool(self.truth()["success"])) and clock.now() < end:
                clock.wait(clock.now() + self.safety.dt)
        except UserError:  # the twin has ended
            return ending.done
        return success

    def _progress(self) -> float | None:
        try:
            return None if self.truth is None else float(self.truth()["progress"])
        except UserError:  # the twin has ended
            return None

    def _held_width(self) -> float | None:
        try:
            reading = self.connection.gripper.read()
        except DriverError:  # the ending says so
            return None
        return reading.width if reading.grasped else None

    def _recorded(self, log: RunLog, ending: Ending, success: bool | None) -> int:
        cell = self.cell
        outcome = {True: "success", False: "failure", None: "unknown"}[success]
        meta: dict[str, Any] = {
            "sensor": cell.sensor,
            "arm": cell.arm,
            "policy": cell.task.policy,
            "outcome": "stopped" if ending.stopped else outcome,
            "ending": ending.reason,
        }
        if success is not None:
            meta["success"] = success
        task = cell.task.instruction or cell.task.name
        return self.record(log.frames(), task, meta)

"""One deployment: start move, task, recorded episode."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.deployment.control_loop import (
    PLAN_ENDED,
    ControlLoop,
    Ending,
    Request,
    RunLog,
    TickStatus,
)
from touchgoal.control.deployment.scripted import start_move
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor, DriverError
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.sensors.exchanged import Picture, cameras_exchanged
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.runtime.errors import UserError

_START_TOLERANCE = 0.02  # rad from the start pose after the start move
_CLOSE_TO_START = 0.1  # rad; nearer than that no start move is made
_START_TIMEOUT = 60.0  # s for the start move
_SETTLE_TIME = 2.0  # s that a simulator may take to see that the task is done
_ASK_INTERVAL = 0.2  # s between questions to a twin

RecordEpisode = Callable[[dict[str, np.ndarray], str, dict[str, Any]], int]
"""Record frames (key -> (T, ...)), instruction and facts as an episode; return its index."""
Truth = Callable[[], dict[str, Any]]
"""Return what a simulator knows of its scene."""


@dataclass(frozen=True)
class Result:
    """Outcome of a deployment.

    Attributes:
        ending: how the run ended.
        log: its record.
        success: whether the task is done, by the simulator or the ending; None: unknown.
        progress: of the task in [0, 1], by the simulator; None without one.
        held_width: width of the object still in the hand, m; None: no object.
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
    """Parts of a deployment.

    Attributes:
        record: saves the episode.
        execute: False: a dry run, which records nothing.
        make_actor: makes the actor when the arm is at its start.
        operator_request, on_tick, cost, camera_size: see ControlLoop.
    """

    cell: CellConfig
    connection: CellConnection
    safety: ActionFilter
    record: RecordEpisode
    execute: bool
    make_actor: Callable[[ControlLoop], Actor]
    operator_request: Callable[[], Request]
    on_tick: Callable[[TickStatus], None]
    cost: Callable[[Observation], float] | None = None
    camera_size: tuple[int, int] = ft.CAMERA_SHAPE[:2]

    def run(self) -> Result:
        """Run start move, task and recording; at the end the arm rests or holds its last command.

        Raises:
            UserError, DriverError: it cannot begin; nothing has moved.
        """
        watch, log = self._success_watch(), RunLog()
        loop = ControlLoop(
            self.connection,
            self.safety,
            self.execute,
            lambda: self.operator_request() or (watch.request() if watch else ""),
            self.on_tick,
            self.cost,
            self.camera_size,
        )
        try:
            ending = self._move_to_start(loop) or self._run_actor(loop, log)
        finally:
            if watch:
                watch.close()
        picked = self.execute and self.cell.task.policy == "expert" and ending.reason == PLAN_ENDED
        if picked and self._held_width() is None:  # it ends with the object in the hand
            ending = Ending(f"{PLAN_ENDED}, but the hand holds nothing", done=False)
        success = self._success(ending)
        episode, recording_error = None, ""
        if self.execute and log.rows:
            try:
                episode = self._record_episode(log, ending, success)
            except (OSError, UserError, MemoryError) as error:
                recording_error = (
                    f"this episode could not be saved ({error}); those before it are whole"
                )
        return Result(
            ending, log, success, self._progress(), self._held_width(), episode, recording_error
        )

    def _success_watch(self) -> "_SuccessWatch | None":
        """Scripts end by themselves; of other actors only a simulator knows when the task is done."""
        truth = self.connection.truth
        if truth is None or self.cell.task.policy == "expert":
            return None
        return _SuccessWatch(truth, self.cell.time_waits)

    def _move_to_start(self, loop: ControlLoop) -> Ending | None:
        """Move to the start pose; the ending if the run cannot go on from there."""
        if self.cell.task.start is None:
            return None
        start = np.array(self.cell.task.start)
        if np.abs(start - loop.commanded()).max() <= _CLOSE_TO_START:
            return None
        move = start_move(start, loop.width, self.safety, loop.commanded)
        before = self._camera_images()
        ending = loop.run(move, _START_TIMEOUT, RunLog())
        if not move.done or ending.stopped:
            return ending
        off = float(np.abs(start - loop.commanded()).max())
        if off > _START_TOLERANCE:
            return loop.stop(
                f"the start pose was missed by {off:.3f} rad", "look for what holds the arm back"
            )
        after = self._camera_images()
        pairs = [(before[key], after[key]) for key in before]
        if len(pairs) == len(ft.CAMERAS) and cameras_exchanged(*pairs):
            return loop.stop(
                "the front and the wrist camera look exchanged: what is called front moves with the arm",
                "exchange cameras.front and cameras.wrist in the cell file",
            )
        return None

    def _camera_images(self) -> dict[str, Picture]:
        """Return the newest image of front and wrist camera, in this order, of those present."""
        cameras = self.connection.cameras
        return {key: cameras[key].read().image for key in ft.CAMERAS if key in cameras}

    def _run_actor(self, loop: ControlLoop, log: RunLog) -> Ending:
        actor = self.make_actor(loop)
        try:
            return loop.run(actor, self.cell.task.seconds, log)
        finally:
            actor.close()

    def _success(self, ending: Ending) -> bool | None:
        """Return the outcome; a run that was stopped is no success, whatever the task looks like."""
        if not self.execute:
            return None
        truth, clock = self.connection.truth, self.connection.clock
        if ending.stopped or truth is None:
            return ending.done
        end = clock.now() + _SETTLE_TIME
        try:
            while not (success := bool(truth()["success"])) and clock.now() < end:
                clock.wait(clock.now() + self.safety.dt)
        except UserError:  # the twin has ended
            return ending.done
        return success

    def _progress(self) -> float | None:
        truth = self.connection.truth
        try:
            return None if truth is None else float(truth()["progress"])
        except UserError:  # the twin has ended
            return None

    def _held_width(self) -> float | None:
        try:
            reading = self.connection.gripper.read()
        except DriverError:  # the ending says so
            return None
        return reading.width if reading.grasped else None

    def _record_episode(self, log: RunLog, ending: Ending, success: bool | None) -> int:
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
        return self.record(log.frames(), cell.task.instruction or cell.task.name, meta)


class _SuccessWatch:
    """Ends a run once the simulator says that the task is done."""

    def __init__(self, truth: Truth, time_waits: bool) -> None:
        """Ask in every tick if the simulated time waits for it, else in a thread."""
        self._truth = truth
        self._thread = None if time_waits else LatestValue("simulator", self._ask_now_and_then)

    def request(self) -> Request:
        return self._thread.read() if self._thread else self._ask()

    def close(self) -> None:
        if self._thread:
            self._thread.close()

    def _ask(self) -> Request:
        return "success" if self._truth()["success"] else ""

    def _ask_now_and_then(self) -> Request:
        time.sleep(_ASK_INTERVAL)
        return self._ask()

"""One deployment: start move, task, recorded episode, report."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.deployment.control_loop import (
    DISCARDED,
    JUDGED,
    PLAN_ENDED,
    TIME_UP,
    ControlLoop,
    Ending,
    Request,
    TickStatus,
)
from touchgoal.control.deployment.scripted import PlannedMove, ScriptedActor, start_move
from touchgoal.control.features import Observation
from touchgoal.control.interfaces import Actor, Cost, CostReading
from touchgoal.control.run_log import SLOW_ARM, RunLog, slow_arm
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.sensors.exchanged import cameras_exchanged
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.control.tactile.light_gain import light_advice
from touchgoal.runtime.errors import UserError

_START_TOLERANCE = 0.02  # rad from the start pose after the start move
_CLOSE_TO_START = 0.1  # rad; nearer than that no start move is made
_START_TIMEOUT = 60.0  # s for the start move
_SETTLE_TIME = 2.0  # s that a simulator may take to see that the task is done
_ASK_INTERVAL = 0.2  # s between questions to a twin
_HOLD_TIME = 1.0  # s that the arm holds still before a judge is asked how the run ended
_BY_JUDGE = {"success": True, "failure": False, "unsure": None}
_VERDICTS = {True: "done", False: "not done", None: "unknown whether it is done"}

Truth = Callable[[], dict[str, Any]]  # return what a simulator knows of its scene


@runtime_checkable
class Recorder(Protocol):
    """Takes one episode tick by tick."""

    def add(self, tick: Observation) -> None:
        """Take a tick; neither waits nor raises: `save` says what failed."""

    def save(self, task: str, meta: dict[str, Any]) -> int:
        """Save the ticks as an episode, return its index; OSError, UserError or MemoryError."""
        ...

    def close(self) -> None:
        """Drop what was not saved."""


@dataclass(frozen=True)
class Result:
    """Outcome of a deployment."""

    ending: Ending  # how the run ended
    log: RunLog  # its figures
    # whether the task is done, by the simulator, the judge, a person or the ending; None: unknown
    success: bool | None
    # of the task in [0, 1], by the simulator; for a task of one's own the share of the distance to
    # its goal that is gone since the start; None without either
    progress: float | None
    held_width: float | None  # width of the object still in the hand, m; None: no object
    episode: int | None  # index of the recorded episode; None without one
    recording_error: str = ""  # why there is none, if there should be one
    judged: CostReading | None = None  # verdict of a judge on the run's end, if one was asked


@dataclass(frozen=True)
class Session:
    """Parts of a deployment."""

    cell: CellConfig
    connection: CellConnection
    safety: ActionFilter
    recorder: Recorder
    execute: bool  # False: a dry run, which records nothing
    make_actor: Callable[[ControlLoop], Actor]  # makes the actor when the arm is at its start
    # operator_request, on_tick, cost, camera_size: see ControlLoop; ask: asks a person whether the task
    # is done, of whom the judge is told to be unsure; returns None if nobody says so
    operator_request: Callable[[], Request]
    on_tick: Callable[[TickStatus], None]
    cost: Cost | None = None
    camera_size: tuple[int, int] = ft.CAMERA_SHAPE[:2]
    ask: Callable[[str], bool | None] = lambda question: None

    def run(self) -> Result:
        """Run start move, task and recording; at the end the arm rests or holds its last command.

        UserError or DriverError if it cannot begin; nothing has moved then.
        """
        with closing(self.recorder):
            return self._run()

    def _run(self) -> Result:
        # Scripts end by themselves; a simulator tells first when the task of other actors is done.
        scripted = self.cell.task.policy == "expert"
        truth = None if scripted else self._truth
        log = RunLog(self.recorder.add) if self.execute else RunLog()
        with _success_requests(truth, self.cell.time_waits) as success_request:
            loop = ControlLoop(
                self.connection,
                self.safety,
                self.execute,
                lambda: self.operator_request() or success_request(),
                self.on_tick,
                self.cost,
                self.camera_size,
            )
            ending = self._move_to_start(loop)
            if ending is None:
                ending = loop.run(self.make_actor(loop), self.cell.task.seconds, log)
        picked = self.execute and scripted and ending.reason == PLAN_ENDED
        if picked and self._held_width() is None:  # it ends with the object in the hand
            ending = Ending(f"{PLAN_ENDED}, but the hand holds nothing", done=False)
        ending, judged = self._judge(ending, loop, log)
        success = self._success(ending)
        episode, recording_error = None, ""
        if self.execute and log.ticks and ending.reason != DISCARDED:
            try:
                episode = self._save_episode(ending, success, judged)
            except (OSError, UserError, MemoryError) as error:
                recording_error = (
                    f"this episode could not be saved ({error}); those before it are whole"
                )
        progress, held = self._progress(log), self._held_width()
        return Result(ending, log, success, progress, held, episode, recording_error, judged)

    @property
    def _truth(self) -> Truth | None:
        """Source of a simulator's ground truth; None for a task of one's own, or one that a judge judges."""
        return None if self.cell.task.own or self.cell.task.judge else self.connection.truth

    def _judge(
        self, ending: Ending, loop: ControlLoop, log: RunLog
    ) -> tuple[Ending, CostReading | None]:
        """Ask the judge, and a person without one or where it is unsure, how a run ended by itself."""
        if self.cost is None or not self.execute or not self.cell.task.judge:
            if ending == Ending(PLAN_ENDED) and self.execute and self._truth is None:
                ending = replace(ending, done=self.ask("the policy says that the task is done"))
            return ending, None
        if ending.reason == PLAN_ENDED or ending.reason.startswith(TIME_UP):
            still = ScriptedActor(
                [PlannedMove(None, loop.width, np.inf)], loop.commanded, ft.CONTROL_HZ
            )
            held = loop.run(still, _HOLD_TIME, log, new=False)
            if held.reason.startswith(TIME_UP):
                told = self.cost.judge()
                if (done := _BY_JUDGE[told.verdict]) is None:
                    why = "; ".join(told.reasons)
                    done = self.ask(f"the judge is unsure whether the task is done ({why})")
                return replace(ending, done=done), told
            ending = held
        if ending.reason == JUDGED:
            return ending, replace(self.cost.read(), verdict="success", reasons=())
        return ending, None

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
        pairs = [(before[key], after[key]) for key in before if key in after]
        if len(pairs) == len(ft.CAMERAS) and cameras_exchanged(*pairs):
            return loop.stop(
                "the front and the wrist camera look exchanged: what is called front moves with the arm",
                "exchange cameras.front and cameras.wrist in the cell file",
            )
        return None

    def _camera_images(self) -> dict[str, Image]:
        """Return the newest image of front and wrist camera, in this order, of those that work."""
        images = {}
        for key in ft.CAMERAS:
            with suppress(Exception):  # there is none, or the loop's next tick names it
                images[key] = self.connection.cameras[key].read().image
        return images

    def _success(self, ending: Ending) -> bool | None:
        """Return the outcome; a run that was stopped is no success, whatever the task looks like."""
        if not self.execute:
            return None
        truth, clock = self._truth, self.connection.clock
        if ending.stopped or truth is None:
            return ending.done
        end = clock.now() + _SETTLE_TIME
        try:
            while not (success := bool(truth()["success"])) and clock.now() < end:
                clock.wait(clock.now() + self.safety.dt)
        except UserError:  # the twin has ended
            return ending.done
        return success

    def _progress(self, log: RunLog) -> float | None:
        try:
            if self._truth is not None:
                return float(self._truth()["progress"])
        except UserError:  # the twin has ended
            return None
        return distance_gone(log) if self.cell.task.own else None

    def _held_width(self) -> float | None:
        try:
            reading = self.connection.gripper.read()
        except Exception:  # of any driver; the ending says so
            return None
        return reading.width if reading.grasped else None

    def _save_episode(
        self, ending: Ending, success: bool | None, judged: CostReading | None
    ) -> int:
        cell, by_judge = self.cell, judged is not None and judged.verdict != "unsure"
        outcome = {True: "success", False: "failure", None: "unknown"}[success]
        outcome = f"judged {outcome}" if by_judge else outcome
        meta: dict[str, Any] = {
            "sensor": cell.sensor,
            "arm": cell.arm,
            "task": cell.task.name,
            "policy": cell.task.policy,
            "outcome": "stopped" if ending.stopped else outcome,
            "ending": ending.reason,
        }
        if judged is not None:
            meta["judged"] = judged.verdict
        if success is not None and not by_judge:  # as a person or a simulator says
            meta["success"] = success
        return self.recorder.save(cell.task.instruction or cell.task.name, meta)


def distance_gone(log: RunLog) -> float | None:
    """Return the share of the first tick's cost that is gone at the end; None without a cost."""
    first, last = (
        float(tick[ft.COST][0]) if ft.COST in tick else 0.0 for tick in (log.first, log.newest)
    )
    return float(np.clip(1 - last / first, 0.0, 1.0)) if first > 0 else None


def metrics(result: Result) -> dict[str, Any]:
    """Return the numbers of a run, for metrics.json."""
    ending, log = result.ending, result.log
    return {
        "reason": ending.reason,
        "stopped": ending.stopped,
        "advice": ending.advice,
        "rest_seconds": ending.rest_seconds,
        "success": result.success,
        "judged": result.judged
        and {"verdict": result.judged.verdict, "reasons": result.judged.reasons},
        "progress": result.progress,
        "held_width": result.held_width,
        "episode": result.episode,
        "recording_error": result.recording_error,
        "ticks": log.ticks,
        "late_p99_ms": 1e3 * float(np.percentile(log.lateness or [0.0], 99)),
        "answered_p95_ms": 1e3 * float(np.percentile(log.answer_times or [0.0], 95)),
        "observation_age_p95_ms": 1e3 * float(np.percentile(log.ages or [0.0], 95)),
        "force_max_newtons": log.max_force,
        "clamped": log.limit_counts,
        "arm_pace": log.arm_pace,
        "light_change": log.light.change,
    }


def report(result: Result, numbers: dict[str, Any], episodes: str) -> str:
    """Return the lines for the operator; `episodes` is the folder recorded into."""
    ending, log = result.ending, result.log
    clamped = ", ".join(f"{name} {n}" for name, n in log.limit_counts.items()) or "never"
    lines = [
        f"{log.ticks} ticks of the control loop; 99 % began at most {numbers['late_p99_ms']:.1f} ms "
        f"late, 95 % were answered within {numbers['answered_p95_ms']:.1f} ms; 95 % of the observations "
        f"were at most {numbers['observation_age_p95_ms']:.0f} ms old",
        f"largest force on the hand: {numbers['force_max_newtons']:.1f} N; commands limited: {clamped}",
    ]
    if log.arm_pace < SLOW_ARM:
        lines.append(slow_arm(log.arm_pace))
    if advice := light_advice([numbers["light_change"]]):
        lines.append(advice)
    if result.held_width is not None:
        lines.append(f"the hand still holds something, {1e3 * result.held_width:.0f} mm wide")
    if result.episode is not None:
        lines.append(
            f"episode {result.episode} is in {episodes}; its curves: touchgoal reward-curves {episodes}"
        )
    lines.append(str(ending) if ending.stopped else f"ended: {ending}")
    if not ending.stopped and (result.episode is not None or result.success is not None):
        lines.append(f"task: {_VERDICTS[result.success]}")
    if (told := result.judged) is not None:
        lines.append("the judge says: " + ", ".join([told.verdict, *told.reasons]))
    return "\n".join(lines)


@contextmanager
def _success_requests(truth: Truth | None, time_waits: bool) -> Iterator[Callable[[], Request]]:
    """Yield what requests a run's end once the simulator, if there is one, says that the task is done.

    It is asked in every tick if the simulated time waits for it, else in a thread.
    """

    def ask() -> Request:
        return "success" if truth and truth()["success"] else ""

    def ask_now_and_then() -> Request:
        time.sleep(_ASK_INTERVAL)
        return ask()

    if truth is None or time_waits:
        yield ask
        return
    with closing(LatestValue("simulator", ask_now_and_then)) as answers:
        answers.read()  # waits for the first answer, so that no tick does
        yield answers.read

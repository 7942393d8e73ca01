"""The cost of a run while it happens, as `reward-curves` computes it from the recording; its judgement."""

import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from threading import Lock

import numpy as np
import torch

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.interfaces import CostReading
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.rewards.curves import FUSED
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.distance.normalizer import REAL_SCENE
from touchgoal.rewards.features.embedded import (
    EmbeddedEpisode,
    EmbeddedGoal,
    Features,
    join_rows,
    split_features,
)
from touchgoal.rewards.features.embedder import FeatureStream
from touchgoal.rewards.goals import Inputs, parse_goal, same_episode
from touchgoal.rewards.judging.judge import Judgement
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.prepared_reward import PreparedReward
from touchgoal.rewards.reward import Reward
from touchgoal.runtime.errors import UserError

_FIRST_COST_TIMEOUT = 60.0  # s for the first cost, which warms up the networks
_IDLE_SLEEP = 0.005  # s between looks for a new tick
_JUDGE_INTERVAL = 1.0  # s from one judgement of a run to the next
_REST_SECONDS, _REST_SPEED = 0.5, 0.02  # s, rad/s: the joints rest if none was faster for so long


class CostMeter:
    """Measures the newest tick of a run, with the numbers of `reward-curves`.

    They are equal from the fifth tick on. Before, the fingertips' background is the median of the
    ticks so far, while a recording's is always that of its first five.

    Attributes:
        judges: whether the run is judged, once a second.
        judgement: the newest; None before the first.
        waiting: ticks to be measured, those of a second at most.
    """

    def __init__(
        self,
        reward: PreparedReward,
        object_name: str = "",
        rate: float = ft.CONTROL_HZ,
        judges: bool = False,
    ) -> None:
        """Prepare for one run.

        UserError if its goal is known only at its end, if several modalities have no normalizer, or
        if it is to be judged without a judge.

        Args:
            object_name: object of the run, which chooses among the goals; "" if unknown.
            rate: ticks per second.
            judges: judge the run by the judge beside the normalizer.
        """
        if same_episode(reward.goals):
            raise UserError("goals last and frame:K are not known before the end of a run")
        if reward.normalizer is None and len(reward.goals) > 1:
            raise UserError(
                "raw distances of several modalities cannot be averaged: give one "
                "goal of one modality (image:PATH or text:SENTENCE), or a normalizer"
            )
        self._reward, self._object, self._rate, self.judges = reward, object_name, rate, judges
        if judges:
            _ = reward.judge  # an error is told before the run
        self.waiting: deque[tuple[float, ft.Observation]] = deque(maxlen=math.ceil(rate))
        self._goal: EmbeddedGoal | None = None
        self._stream: FeatureStream | None = None
        self.forget()
        self._begin(())

    def _begin(self, background: Sequence[ft.Observation]) -> None:
        self._background = background  # ticks that the stream's background is the median of
        self._parts: dict[str, float] = {}  # cost of each part at the tick before
        self._felt: list[Features] = []  # of touch and arm, of all ticks so far
        self._seen: EmbeddedEpisode | None = None  # the newest ticks, images included
        self._moved = self._unjudged = 0  # ticks since a joint moved, and since the last judgement
        self.judgement: Judgement | None = None
        self._successes = 0  # judgements in a row

    def forget(self) -> None:
        """Take the next tick as the first one of a run."""
        self._first: tuple[ft.Observation, ...] = ()
        self.waiting.clear()

    def add(self, tick: ft.Observation) -> None:
        """Take the next tick; the first 5 are free of contact."""
        if len(self._first) < START_FRAMES:
            self._first = (*self._first, tick)
        self.waiting.append((time.monotonic(), tick))

    def measure(self) -> CostReading | None:
        """Return the cost of the newest tick, fused, or the mean over the modalities without parts.

        None if it was measured before. A judge needs the ticks before it, too, but not their images.
        While less than 5 ticks have come in, each changes the background, and all are measured anew.
        The run is done once two judgements, a second apart, said success while the arm rested.
        """
        first, waiting = self._first, []
        while self.waiting:
            waiting.append(self.waiting.popleft())
        if not waiting:
            return None
        stamp, newest = waiting[-1]
        first = first or (newest,)
        ticks = [tick for _, tick in waiting] if self.judges else [newest]
        seen, known, reward = 1, self._background, self._reward
        if self._stream is None or len(first) != len(known) or first[0] is not known[0]:
            missed = len(ticks) > 1
            ticks = list({id(tick): tick for tick in (*first, *ticks)}.values())
            seen = 1 if missed else len(ticks)
            self._stream = reward.embedder.stream(_stacked(first), self._rate, "this run")
            self._begin(first)
        embedded = replace(self._stream.embed(_stacked(ticks, seen)), object=self._object)
        trajectory = embedded.take(slice(-seen, None))
        if self._goal is None:
            self._goal = reward.embedder.embed_goal(reward.goals, trajectory)
        curves = compute_curves(
            trajectory, self._goal, reward.normalizer, reward.value, self._parts, reward.plain
        )
        self._parts = {name: float(cost[-1]) for name, cost in curves.parts.items()}
        names = [FUSED] if FUSED in curves.parts else curves.raw
        cost = float(np.mean([curves.costs[name][-1] for name in names]))
        if self.judges:
            self._seen = trajectory
            self._felt.append(split_features(embedded.features)[1])
            for tick in ticks:
                self._moved = 0 if _joint_speed(tick) > _REST_SPEED else self._moved + 1
            self._unjudged += len(ticks)
            if self._unjudged >= _JUDGE_INTERVAL * self._rate:
                self.judge()
        if (told := self.judgement) is None:
            return CostReading(cost, stamp)
        return CostReading(cost, stamp, told.verdict, told.reasons, self._successes > 1)

    def judge(self) -> Judgement:
        """Judge the newest tick as the end of the run; at least one was measured."""
        assert self._seen is not None
        self._felt, self._unjudged = [join_rows(self._felt)], 0
        seen = split_features(self._seen.features)[0]
        told = self._reward.judge_episode(replace(self._seen, features={**seen, **self._felt[0]}))
        rests = self._moved >= _REST_SECONDS * self._rate
        self._successes = self._successes + 1 if told.verdict == "success" and rests else 0
        self.judgement = told
        return told


def _stacked(ticks: Sequence[ft.Observation], seen: int | None = None) -> dict[str, np.ndarray]:
    """Return what the cost reads of some ticks, by key; images of the last `seen` alone."""
    keys = [key for key in (*ft.CAMERAS, *ft.TACTILE, ft.WRENCH, ft.TCP_POSE) if key in ticks[0]]
    last = ticks[-(seen or len(ticks)) :]
    return {k: np.stack([t[k] for t in (last if k in ft.CAMERAS else ticks)]) for k in keys}


def _joint_speed(tick: ft.Observation) -> float:
    """Speed of the fastest joint, rad/s; infinite if it is unknown."""
    state = tick.get(ft.STATE)
    return np.inf if state is None else float(np.abs(state[len(state) // 2 : -1]).max())


class OnlineCost:
    """Measures the newest tick in a thread, whenever the one before is done."""

    def __init__(self, meter: CostMeter, time_waits: bool = False) -> None:
        """Start the thread; `close` ends it.

        Args:
            meter: measures the run.
            time_waits: wait for the meter rather than leave out ticks that a judge needs.
        """
        self._meter, self._waits = meter, time_waits
        self._begun = False
        self._measuring = Lock()
        self._latest = LatestValue("cost", self._measure_newest, _FIRST_COST_TIMEOUT)

    def begin(self, observation: ft.Observation) -> None:
        """See Cost; the first measurement warms up the networks."""
        self._begun = False
        self._meter.forget()
        self._meter.add(observation)

    def hand_over(self, observation: ft.Observation) -> None:
        """See Cost."""
        if not self._begun:
            self._meter.forget()  # what `begin` was given
            self._begun = True
        waiting = self._meter.waiting
        while self._waits and self._meter.judges and len(waiting) == waiting.maxlen:
            self._latest.read()  # DriverError if the thread has ended
            time.sleep(_IDLE_SLEEP)
        self._meter.add(observation)

    def read(self) -> CostReading:
        """See Cost; the cost is the mean over the modalities that have a goal.

        It is normalised, or the cosine distance without a normalizer.
        """
        return self._latest.read()

    def judge(self) -> CostReading:
        """See Cost."""
        reading = self._latest.read()  # DriverError if no cost can be measured
        with self._measuring:
            reading = self._meter.measure() or reading
            if not self._meter.judges:
                return reading
            told = self._meter.judge()
        return replace(reading, verdict=told.verdict, reasons=told.reasons)

    def close(self) -> None:
        """End the thread."""
        self._latest.close()

    def _measure_newest(self) -> CostReading | None:
        torch.set_num_threads(1)  # of this thread: the control loop needs the other core
        with self._measuring:
            reading = self._meter.measure()
        if reading is None:
            time.sleep(_IDLE_SLEEP)
        return reading


def load_cell_cost(cell: CellConfig) -> OnlineCost:
    """Return the distance to the cell's goals, measured in a thread; `close` ends it.

    UserError: a goal, encoder or normalizer that does not fit the cell.
    """
    # a task of one's own is recorded without a simulator's truth, on a twin, too
    simulated = (cell.arm == "sim" or bool(cell.task.twin)) and not cell.task.own
    keys = {f"{ft.IMAGE_PREFIX}{name}" for name in cell.cameras}
    task = cell.task
    inputs = Inputs.of(
        "the cell",
        keys | set(ft.TACTILE if cell.fingertips is not None else ()),
        sensor=cell.sensor,
        scene=f"simulated {task.simulated}" if simulated else REAL_SCENE,
        task=task.instruction or task.name,
    )
    if task.judge:
        reward = Reward.of_judge(task.judge, task.encoder or None)
    else:
        reward = Reward(
            [parse_goal(text) for text in task.rewards],
            encoder=task.encoder or None,
            normalizer=task.normalizer or None,
        )
    item = task.objects[0] if len(task.objects) == 1 else ""
    meter = CostMeter(reward.prepare(inputs), item, judges=bool(task.judge))
    return OnlineCost(meter, cell.time_waits)

"""The cost of a run while it happens, as `reward-curves` computes it from the recording."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from touchgoal.control import features as ft
from touchgoal.control.cell.config import CellConfig
from touchgoal.control.interfaces import CostReading
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.rewards.curves import FUSED
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.distance.normalizer import REAL_SCENE
from touchgoal.rewards.features.embedded import EmbeddedGoal
from touchgoal.rewards.features.embedder import FeatureStream
from touchgoal.rewards.goals import Inputs, parse_goal, same_episode
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.reward import PreparedReward, Reward
from touchgoal.runtime.errors import UserError

_FIRST_COST_TIMEOUT = 30.0  # s for the first cost, which warms up the networks
_IDLE_SLEEP = 0.005  # s between looks for a new tick


class CostMeter:
    """Measures the cost of one tick after the other, with the numbers of `reward-curves`.

    They are equal from the fifth tick on. Before, the fingertips' background is the median of the
    ticks so far, while a recording's is always that of its first five.
    """

    def __init__(
        self, reward: PreparedReward, object_name: str = "", rate: float = ft.CONTROL_HZ
    ) -> None:
        """Prepare for one run.

        UserError if its goal is known only at its end, or if several modalities have no normalizer.

        Args:
            object_name: object of the run, which chooses among the goals; "" if unknown.
            rate: ticks per second.
        """
        if same_episode(reward.goals):
            raise UserError("goals last and frame:K are not known before the end of a run")
        if reward.normalizer is None and len(reward.goals) > 1:
            raise UserError(
                "raw distances of several modalities cannot be averaged: give one "
                "goal of one modality (image:PATH or text:SENTENCE), or a normalizer"
            )
        self._reward, self._object, self._rate = reward, object_name, rate
        self._goal: EmbeddedGoal | None = None
        self._stream: FeatureStream | None = None
        self._first: Sequence[ft.Observation] = ()  # that the stream's background is the median of
        self._parts: dict[str, float] = {}  # cost of each part at the tick before

    def measure(self, observation: ft.Observation, first: Sequence[ft.Observation]) -> float:
        """Return the cost of a tick: fused, or the mean over the modalities without parts.

        `first` are the run's first ticks in order, at most five. While more of them come in, the
        background changes, and they are measured anew.
        """
        ticks, known = [observation], self._first
        if self._stream is None or len(first) != len(known) or first[0] is not known[0]:
            before = [tick for tick in first if tick is not observation]
            ticks = [*before, observation]
            embedder = self._reward.embedder
            self._stream = embedder.stream(_stacked(first), self._rate, "this run")
            self._first, self._parts = first, {}
        trajectory = replace(self._stream.embed(_stacked(ticks)), object=self._object)
        reward = self._reward
        if self._goal is None:
            self._goal = reward.embedder.embed_goal(reward.goals, trajectory)
        curves = compute_curves(
            trajectory, self._goal, reward.normalizer, reward.value, self._parts, reward.plain
        )
        self._parts = {name: float(cost[-1]) for name, cost in curves.parts.items()}
        if FUSED in curves.parts:
            return self._parts[FUSED]
        return float(np.mean([curves.costs[name][-1] for name in curves.raw]))


def _stacked(ticks: Sequence[ft.Observation]) -> dict[str, np.ndarray]:
    """Return what the cost reads of some ticks, by key."""
    keys = [key for key in (*ft.CAMERAS, *ft.TACTILE, ft.WRENCH, ft.TCP_POSE) if key in ticks[0]]
    return {key: np.stack([tick[key] for tick in ticks]) for key in keys}


class OnlineCost:
    """Measures the newest tick in a thread, whenever the one before is done."""

    def __init__(self, meter: CostMeter, give_up: float = 0.0) -> None:
        """Start the thread; `close` ends it. `give_up`: rise of the cost that is a failure; 0: none."""
        self._meter, self._rise = meter, give_up or float("inf")
        self.failed = False  # whether the cost has risen by `give_up` for 20 measurements
        self._first: tuple[ft.Observation, ...] = ()  # the run's first ticks, without contact
        self._newest: tuple[float, ft.Observation, tuple[ft.Observation, ...]] | None = None
        self._latest = LatestValue("cost", self._measure_newest, _FIRST_COST_TIMEOUT)

    def begin(self, observation: ft.Observation) -> None:
        """See Cost; the first measurement warms up the networks."""
        self.failed, self._first = False, ()
        self._watch, self._watched = FailureWatch(self._rise, ft.CONTROL_HZ), time.monotonic()
        self._newest = time.monotonic(), observation, (observation,)

    def hand_over(self, observation: ft.Observation) -> None:
        """See Cost."""
        if len(self._first) < START_FRAMES:
            self._first = (*self._first, observation)
        self._newest = time.monotonic(), observation, self._first

    def read(self) -> CostReading:
        """See Cost; the cost is the mean over the modalities that have a goal.

        It is normalised, or the cosine distance without a normalizer.
        """
        reading = self._latest.read()
        if reading.stamp > self._watched:
            self._watched = reading.stamp
            self.failed |= self._watch.update(reading.cost)
        return reading

    def close(self) -> None:
        """End the thread."""
        self._latest.close()

    def _measure_newest(self) -> CostReading | None:
        newest, self._newest = self._newest, None
        if newest is None:
            time.sleep(_IDLE_SLEEP)
            return None
        torch.set_num_threads(1)  # of this thread: the control loop needs the other core
        stamp, observation, first = newest
        return CostReading(self._meter.measure(observation, first), stamp)


class FailureWatch:
    """Watches the cost of a run, measurement by measurement.

    The run has failed once the cost has stayed `rise` above its lowest value so far for `n`
    measurements in a row: an object lost, or carried away from its goal. A run that gets nowhere
    keeps its cost and is left to its time limit.
    """

    def __init__(self, rise: float, n: int) -> None:
        self._rise, self._n = rise, n
        self._lowest, self._above = float("inf"), 0

    def update(self, cost: float) -> bool:
        """Take the next cost; return whether the run has failed."""
        self._lowest = min(self._lowest, cost)
        self._above = self._above + 1 if cost > self._lowest + self._rise else 0
        return self._above >= self._n


def load_cell_cost(cell: CellConfig) -> OnlineCost:
    """Return the distance to the cell's goals, measured in a thread; `close` ends it.

    UserError: a goal, encoder or normalizer that does not fit the cell.
    """
    simulated = cell.arm == "sim" or bool(cell.task.twin)
    cameras = tuple(key for key in ft.CAMERAS if key.removeprefix(ft.IMAGE_PREFIX) in cell.cameras)
    inputs = Inputs(
        name="the cell",
        camera=ft.FRONT if ft.FRONT in cameras else None,
        sides=ft.TACTILE if cell.fingertips is not None else (),
        sensor=cell.sensor,
        scene=f"simulated {cell.task.simulated}" if simulated else REAL_SCENE,
        cameras=cameras,
        task=cell.task.instruction or cell.task.name,
    )
    task = cell.task
    reward = Reward(
        [parse_goal(text) for text in task.rewards],
        encoder=task.encoder or None,
        normalizer=task.normalizer or None,
    )
    meter = CostMeter(reward.prepare(inputs), task.objects[0] if len(task.objects) == 1 else "")
    return OnlineCost(meter, task.give_up)

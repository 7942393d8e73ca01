"""The cost of a trajectory while it happens, as `reward-curves` computes it from the recording."""

import time
from collections.abc import Sequence

import numpy as np
import torch

from touchgoal.control.cell.config import CellConfig
from touchgoal.control.features import CONTROL_HZ, FRONT, IMAGE_PREFIX, TACTILE, Observation
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.distance.embedding_distance import compute_curves
from touchgoal.rewards.distance.normalizer import REAL_SCENE
from touchgoal.rewards.features.embedded import EmbeddedEpisode, EmbeddedGoal
from touchgoal.rewards.goals import Inputs, parse_goal
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.reward_model import RewardModel, load_reward_model
from touchgoal.runtime.errors import UserError

_FIRST_COST_TIMEOUT = 30.0  # s for the first cost, which warms up the networks
_IDLE_SLEEP = 0.005  # s between looks for a new tick


class CostMeter:
    """Measures the cost of one tick after the other, with the numbers of `reward-curves`.

    They are equal from the fifth tick on. Before, the fingertips' background is the median of the
    ticks so far, while a recording's is always that of its first five.
    """

    def __init__(self, model: RewardModel) -> None:
        """Prepare for one run, to goals from outside it; without a normalizer, of one modality.

        UserError: a goal that is known only at the end, or raw distances of several modalities.
        """
        if model.goal.same_episode:
            raise UserError("task.rewards: last and frame:K are not known before the end")
        if model.normalizer is None and len(model.goal.as_dict()) > 1:
            raise UserError(
                "task.rewards: raw distances of several modalities cannot be averaged: give one "
                "goal of one modality (image:PATH or text:SENTENCE), or a normalizer"
            )
        self._model, self._embedder = model, model.embedder
        self._goal: EmbeddedGoal | None = None

    def measure(self, observation: Observation, first: Sequence[Observation]) -> float:
        """Return the cost of a tick; `first` are the run's first ticks in order, at most five."""
        tick = self._embed(observation, first)
        if self._goal is None:
            self._goal = self._embedder.embed_goal(self._model.goal, tick)
        curves = compute_curves(tick, self._goal, self._model.normalizer)
        return float(np.mean([curves.costs[name][0] for name in curves.raw]))

    def _embed(self, observation: Observation, first: Sequence[Observation]) -> EmbeddedEpisode:
        """Return one tick as an episode."""
        sides = tuple(key for key in TACTILE if key in observation)
        touch = [
            self._embedder.embed_touch(
                observation[key][None], touch_background(np.stack([tick[key] for tick in first]))
            )
            for key in sides
        ]
        front = observation.get(FRONT)
        return EmbeddedEpisode(
            source="this run",
            fps=CONTROL_HZ,
            contact=Contact(None, "not looked for"),
            made_with=self._embedder.made_with,
            image=None if front is None else self._embedder.embed_pictures(front[None]),
            sides=sides,
            touch=np.stack(touch) if touch else None,
            words=self._embedder.knows_words,
        )


class OnlineCost:
    """Measures the newest tick in a thread, whenever the one before is done."""

    def __init__(self, meter: CostMeter) -> None:
        """Start the thread; `close` ends it."""
        self._meter = meter
        self._first: tuple[Observation, ...] = ()  # ticks without contact
        self._newest: tuple[Observation, tuple[Observation, ...]] | None = None
        self._latest = LatestValue("cost", self._measure_newest, _FIRST_COST_TIMEOUT)

    def latest_cost(self, observation: Observation) -> float:
        """Hand over a tick; return the newest cost, of this tick or an earlier one.

        Call it with every tick from the first on. The cost is the mean over the modalities that
        have a goal: normalised, or the cosine distance without a normalizer. Only the first call
        waits. DriverError, with the reason, if nothing can be measured.
        """
        if len(self._first) < START_FRAMES:
            self._first = (*self._first, observation)
        self._newest = observation, self._first
        return self._latest.read()

    def close(self) -> None:
        """End the thread."""
        self._latest.close()

    def _measure_newest(self) -> float | None:
        newest, self._newest = self._newest, None
        if newest is None:
            time.sleep(_IDLE_SLEEP)
            return None
        torch.set_num_threads(1)  # of this thread: the control loop needs the other core
        return self._meter.measure(*newest)


def load_cell_cost(cell: CellConfig) -> OnlineCost:
    """Return the distance to the cell's goals, measured in a thread; `close` ends it.

    UserError: a goal, encoder or normalizer that does not fit the cell.
    """
    simulated = cell.arm == "sim" or bool(cell.task.twin)
    inputs = Inputs(
        name="the cell",
        camera=FRONT if FRONT.removeprefix(IMAGE_PREFIX) in cell.cameras else None,
        sides=TACTILE if cell.fingertips is not None else (),
        sensor=cell.sensor,
        scene=f"simulated {cell.task.name}" if simulated else REAL_SCENE,
    )
    goals = [parse_goal(text) for text in cell.task.rewards]
    task = cell.task
    model = load_reward_model(
        inputs, goals, task.encoder or None, normalizer=task.normalizer or None
    )
    return OnlineCost(CostMeter(model))

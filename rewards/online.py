"""The cost of a trajectory while it happens: what `reward-curves` would say of the newest tick."""

import time
from collections.abc import Sequence

import numpy as np
import torch

from touchgoal.control.features import CONTROL_HZ, FRONT, TACTILE, Observation
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import Towers
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import Contact
from touchgoal.rewards.embedding_distance import (
    EmbeddedEpisode,
    EmbeddedGoal,
    EpisodeEmbedder,
    compute_curves,
)
from touchgoal.rewards.goals import GoalSpec, assign_goals
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.normalizer import DistanceNormalizer
from touchgoal.runtime.errors import UserError

_FIRST_COST_TIMEOUT = 30.0  # s for the first cost, which warms everything up
_IDLE_SLEEP = 0.005  # s between looks for a new tick


class CostMeter:
    """The cost of one tick after the other, by the same steps as `reward-curves`.

    From the fifth tick on the numbers are the same. Before, the fingertips' background is the median
    of the ticks there have been, while a recording's is always that of its first five.
    """

    def __init__(
        self,
        towers: Towers,
        encoder: AnyTouchEncoder,
        normalizer: DistanceNormalizer | None,
        goals: Sequence[GoalSpec],
    ) -> None:
        """For one run.

        Args:
            towers: frozen image and text towers.
            encoder: touch encoder, aligned with them if a goal is a sentence.
            normalizer: fitted with these encoders on episodes of this scene; None for the raw
                cosine distance, of goals that speak for one modality alone.
            goals: each modality takes the first that speaks for it; what none speaks for is left
                out. Frames of the episode itself are not known yet and cannot be goals.
        """
        self._normalizer, self._goals = normalizer, goals
        self._embedder = EpisodeEmbedder(towers, encoder)
        self._goal: EmbeddedGoal | None = None

    def measure(self, observation: Observation, first: Sequence[Observation]) -> float:
        """The cost of a tick; `first` are the run's first ticks, in their order, five at most."""
        episode = self._embed(observation, first)
        if self._goal is None:
            goal = assign_goals(self._goals, episode.modalities)
            if goal.own:
                raise UserError("task.rewards: last and frame:K are not known before the end")
            self._goal = self._embedder.embed_goal(goal, episode)
            if self._normalizer is None and len(goal.as_dict()) > 1:
                raise UserError(
                    "task.rewards: raw distances of several modalities cannot be averaged: give "
                    "one goal of one modality (image:PATH or text:SENTENCE), or a normalizer"
                )
        curves = compute_curves(episode, self._goal, self._normalizer)
        return float(np.mean([curves.costs[name][0] for name in curves.raw]))

    def _embed(self, observation: Observation, first: Sequence[Observation]) -> EmbeddedEpisode:
        """One tick as an episode."""
        if FRONT not in observation:
            raise UserError("task.rewards: the cost looks through the front camera: add it")
        sides = tuple(key for key in TACTILE if key in observation)
        touch = [
            self._embedder.embed_touch(
                observation[key][None], touch_background(np.stack([tick[key] for tick in first]))
            )
            for key in sides
        ]
        return EmbeddedEpisode(
            source="this run",
            fps=CONTROL_HZ,
            contact=Contact(None, "not looked for"),
            made_with=self._embedder.made_with,
            image=self._embedder.embed_pictures(observation[FRONT][None]),
            sides=sides,
            touch=np.stack(touch) if touch else None,
            words=self._embedder.knows_words,
        )


class OnlineCost:
    """Measures ticks in a thread: the newest one whenever it is through with the last."""

    def __init__(self, meter: CostMeter) -> None:
        """Starts the thread; `close` ends it."""
        self._meter = meter
        self._first: tuple[Observation, ...] = ()  # ticks in which nothing is touched
        self._newest: tuple[Observation, tuple[Observation, ...]] | None = None
        self._latest = LatestValue("cost", self._measure_newest, _FIRST_COST_TIMEOUT)

    def latest_cost(self, observation: Observation) -> float:
        """Hand every tick over, from the first; the newest cost there is, of this tick or an earlier one.

        The mean over the modalities that have a goal, each 1 at the usual start and 0 at the usual
        end or nearer; without a normalizer the cosine distance. It waits for the first one alone.
        DriverError, with the reason, if nothing can be measured.
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

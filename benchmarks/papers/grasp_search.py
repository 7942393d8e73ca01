"""Grasp and lift found by trial: the cost at the end of each trial says where to grasp next.

The last mean of the cross-entropy method is tried once. The object's position is known to some
centimetres only.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.cross_entropy import Points, search
from benchmarks.papers.reward_objects import HELD_OUT_OBJECTS
from touchgoal.control.features import CAMERAS, TACTILE, WRENCH, Observation
from touchgoal.episodes.schema import Episode
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.rewards.curves import FUSED
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.features.embedded import EmbeddedEpisode, EmbeddedGoal, last_rows
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.reward import Reward
from touchgoal.rewards.reward_wrapper import inputs_of
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Positive, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.experts.pick_place_plans import lift_plan
from touchgoal.sim_envs.pick_place import PickPlace

_FIRST_SEED = seeds.REWARD_TEST.start + 780_000
_LIFTED = 0.05  # m, of the 0.12 that the hand rises by
ROWS = (FUSED, "image", "tactile", "chance", "first guess")
"""How the best third of the trials is chosen: by a cost, or at random ("chance"); "first guess" is the
mean before any trial."""

Shift = Float[np.ndarray, "3"]


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark grasp-search."""

    scenes: Count = 20
    """Scenes, each with another object and place."""
    rounds: Count = 3
    """Rounds of trials."""
    samples: Count = 12
    """Trials of a round."""
    error: Positive = 0.03
    """Standard deviation of the first guess from the object, m."""
    goals: Count = 3
    """Lifts of the same object elsewhere that are the goal."""
    encoder: str = "gelsight_mini"
    """Touch encoder, by name or folder."""
    env: PickPlaceConfig = PickPlaceConfig(cameras=("front", "wrist"))
    """Environment."""
    workers: Count = CORES
    """Processes that simulate."""


def run(config: Config) -> dict[str, Any]:
    """Search in every scene by every row."""
    jobs = list(product(range(config.scenes), ROWS))
    with parallel_map(partial(_search, config), jobs, config.workers) as results:
        lifted = list(track(results, "searching", "search", total=len(jobs)))
    rows = {
        name: [done for (_, row), done in zip(jobs, lifted, strict=True) if row == name]
        for name in ROWS
    }
    trials = config.rounds * config.samples
    lines = [f"{'best third chosen by':<24}object lifted after {trials} trials [95 % Wilson]"]
    lines += [f"{name:<24}{SuccessRate(sum(done), len(done))}" for name, done in rows.items()]
    return {"table": "\n".join(lines), "lifted": rows}


def _search(config: Config, job: tuple[int, str]) -> bool:
    """Return whether the last mean of a search lifts the object."""
    torch.set_num_threads(1)
    scene, row = job
    seed = _FIRST_SEED + scene
    rng = np.random.default_rng(seed)
    spread = config.error * np.array([1, 1, 0.5])
    mean = rng.normal(0, spread)
    rig = _Rig(config, HELD_OUT_OBJECTS[scene % len(HELD_OUT_OBJECTS)])
    if row != "first guess":
        goal = rig.goal(range(seed + 1000, seed + 1000 + 100 * config.goals, 100))

        def costs(shifts: Points) -> Sequence[float]:
            if row == "chance":
                return rng.random(len(shifts)).tolist()
            return rig.costs([rig.lift(seed, shift)[0] for shift in shifts], goal, row)

        mean = search(rng, mean, spread, config.rounds, config.samples, costs)
    _, lifted = rig.lift(seed, mean)
    rig.env.close()
    return lifted


class _Rig:
    """Tries grasps of one object."""

    def __init__(self, config: Config, name: str) -> None:
        self.env = PickPlace(replace(config.env, objects=(name,)))
        self._reward = Reward(encoder=config.encoder).prepare(inputs_of(self.env))

    def lift(self, seed: int, shift: Shift) -> tuple[Episode, bool]:
        """Try a grasp `shift` (m) beside the object; return first and last frames, and whether it rose."""
        env = self.env
        observation, _ = env.reset(seed=seed)
        rest = env.object_pose()[2]
        plan = lift_plan(env, [*shift[:2], max(shift[2], 0.0)])  # lower would meet the table
        expert, seen = PickPlaceExpert(env, plan=plan), [observation]
        for _ in range(round(sum(w.seconds for w in plan) * env.config.control_hz)):
            observation, _, ended, _, _ = env.step(expert.act(observation))
            seen = [*seen[:START_FRAMES], observation]
            if ended:
                break
        return _episode(seen), bool(env.object_pose()[2] - rest > _LIFTED)

    def goal(self, lifts: Iterable[int]) -> EmbeddedGoal:
        """Return the ends of lifts by somebody who knows where the object is."""
        return EmbeddedGoal(
            last_rows(self._embed(self.lift(seed, np.zeros(3))[0]) for seed in lifts)
        )

    def costs(self, ends: Sequence[Episode], goal: EmbeddedGoal, row: str) -> list[float]:
        """Return the last cost of each trial; the shipped value, which is of another task, is left out."""
        curves = [compute_curves(self._embed(e), goal, self._reward.normalizer) for e in ends]
        return [float({**c.costs, **c.plain}[row][-1]) for c in curves]

    def _embed(self, episode: Episode) -> EmbeddedEpisode:
        return self._reward.embedder.embed_episode(episode, 1.0, "a trial")


def _episode(seen: Sequence[Observation]) -> Episode:
    keys = [key for key in (*CAMERAS, *TACTILE, WRENCH) if key in seen[0]]
    return Episode({key: np.stack([o[key] for o in seen]) for key in keys}, "", {})

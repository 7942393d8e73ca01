"""Running actors in a task: many episodes, on all cores, judged by the simulator."""

from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from touchgoal.control import vocabulary as v
from touchgoal.episodes.recording import Demonstration, one_core_workers, run
from touchgoal.sim_envs.experts import PickPlaceExpert
from touchgoal.sim_envs.pick_place import PickPlace, PickPlaceConfig


@dataclass(frozen=True)
class Trial:
    """One episode's result.

    Attributes:
        progress: the greatest reached, in [0, 1].
        error: distance of the object to the goal at the end, m.
        peak_force: the greatest normal force on a pad, N.
    """

    seed: int
    object: str
    shape: str
    mass: float
    grasp_force: float
    success: bool
    progress: float
    error: float
    peak_force: float
    ticks: int


def evaluate_expert(
    config: PickPlaceConfig, demonstrations: list[Demonstration], workers: int
) -> list[Trial]:
    """Run the expert on every demonstration's seed and options."""
    with one_core_workers(workers) as pool:
        trials = pool.map(_try_expert, [config] * len(demonstrations), demonstrations)
        return list(tqdm(trials, total=len(demonstrations), desc="trials", unit="episode"))


def _try_expert(config: PickPlaceConfig, demonstration: Demonstration) -> Trial:
    env = PickPlace(config)
    observation, info = env.reset(seed=demonstration.seed, options=demonstration.options)
    expert = PickPlaceExpert(env, demonstration.outcome)
    ticks = list(run(env, expert, observation, info))
    body, last = env.bodies[0], ticks[-1]
    error = np.linalg.norm(last[v.TRUTH_OBJECT_POSE][:2] - env.goal)
    normal = np.stack([tick[v.TRUTH_PAD_WRENCH][[2, 8]] for tick in ticks])
    env.close()
    return Trial(
        seed=demonstration.seed,
        object=body.kind.name,
        shape=body.kind.shape,
        mass=body.mass,
        grasp_force=env.grasp_force,
        success=bool(last[v.TRUTH_SUCCESS][0]),
        progress=max(float(tick[v.TRUTH_PROGRESS][0]) for tick in ticks),
        error=float(error),
        peak_force=float(np.abs(normal).max()),
        ticks=len(ticks) - 1,
    )

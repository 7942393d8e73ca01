"""Running actors in pick-and-place: many episodes, on all cores, judged by the simulator."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from touchgoal.control import features as ft
from touchgoal.episodes.recording import Actor, EpisodeSpec, one_core_workers, run
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace


@dataclass(frozen=True)
class Trial:
    """One episode's result.

    Attributes:
        progress: the greatest reached, in [0, 1].
        error: distance of the object to the goal at the end, m.
        peak_force: the greatest normal force on a pad, N.
        peak_load: the greatest external force on the hand, N.
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
    peak_load: float
    ticks: int


def demonstrations_of(objects: list[str], count: int, seed: int) -> list[EpisodeSpec]:
    """So many trials, with the objects in turn; the seeds, from `seed` on, do the rest."""
    return [
        EpisodeSpec(seed + i, options={"object": objects[i % len(objects)]}) for i in range(count)
    ]


def evaluate(
    config: PickPlaceConfig,
    policy: Callable[[PickPlace], Actor],
    demonstrations: list[EpisodeSpec],
    workers: int,
) -> list[Trial]:
    """Run what `policy` makes for each demonstration's environment; it must pickle."""
    n = len(demonstrations)
    with one_core_workers(workers) as pool:
        trials = pool.map(_try, [config] * n, [policy] * n, demonstrations)
        return list(tqdm(trials, total=n, desc="trials", unit="episode"))


def _try(
    config: PickPlaceConfig, policy: Callable[[PickPlace], Actor], demonstration: EpisodeSpec
) -> Trial:
    env = PickPlace(config)
    observation, info = env.reset(seed=demonstration.seed, options=demonstration.options)
    ticks = list(run(env, policy(env), observation, info))
    body, last = env.bodies[0], ticks[-1]
    error = np.linalg.norm(last[ft.TRUTH_OBJECT_POSE][:2] - env.goal)
    normal = np.stack([tick[ft.TRUTH_PAD_WRENCH][[2, 8]] for tick in ticks])
    env.close()
    return Trial(
        seed=demonstration.seed,
        object=body.kind.name,
        shape=body.kind.shape,
        mass=body.mass,
        grasp_force=env.grasp_force,
        success=bool(last[ft.TRUTH_SUCCESS][0]),
        progress=max(float(tick[ft.TRUTH_PROGRESS][0]) for tick in ticks),
        error=float(error),
        peak_force=float(np.abs(normal).max()),
        peak_load=max(float(np.linalg.norm(tick[ft.WRENCH][:3])) for tick in ticks),
        ticks=len(ticks) - 1,
    )

"""Running actors on exact lists of wires, on all cores, judged by the simulator."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from touchgoal.control import features as ft
from touchgoal.episodes.recording import Actor, EpisodeSpec, one_core_workers, run
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import BeadMazeConfig
from touchgoal.sim_envs.scene.wires import Wire

FAILURES = ft.FEATURES[ft.TRUTH_FAILURE].names


@dataclass(frozen=True)
class MazeTrial:
    """One run along one wire.

    Attributes:
        progress: the greatest fraction of the wire reached.
        failure: what ended it: drop, jam, over_force, time (is up), or nothing.
        peak_force: the greatest external force on the hand, N.
        mean_force: its mean, N.
    """

    wire: str
    family: str
    seed: int
    success: bool
    progress: float
    failure: str
    peak_force: float
    mean_force: float
    seconds: float


def trials_of(wires: list[Wire], seed: int) -> list[EpisodeSpec]:
    """One trial on each wire; the seeds, from `seed` on, place the maze and grip the bead."""
    return [EpisodeSpec(seed + i, options={"wire": w.name}) for i, w in enumerate(wires)]


def evaluate(
    config: BeadMazeConfig,
    policy: Callable[[BeadMaze], Actor],
    trials: list[EpisodeSpec],
    workers: int,
) -> list[MazeTrial]:
    """Run what `policy` makes for each trial's environment; it must pickle."""
    n = len(trials)
    with one_core_workers(workers) as pool:
        results = pool.map(_try, [config] * n, [policy] * n, trials)
        return list(tqdm(results, total=n, desc="trials", unit="wire"))


def _try(
    config: BeadMazeConfig, policy: Callable[[BeadMaze], Actor], trial: EpisodeSpec
) -> MazeTrial:
    env = BeadMaze(config)
    observation, info = env.reset(seed=trial.seed, options=trial.options)
    forces, progress, tick = [], 0.0, info
    for tick in run(env, policy(env), observation, info):
        forces.append(float(np.linalg.norm(tick[ft.WRENCH][:3])))
        progress = max(progress, float(tick[ft.TRUTH_PROGRESS][0]))
    env.close()
    success = bool(tick[ft.TRUTH_SUCCESS][0])
    failures = [FAILURES[i] for i in np.flatnonzero(tick[ft.TRUTH_FAILURE])]
    return MazeTrial(
        wire=env.wire.name,
        family=env.wire.family,
        seed=trial.seed,
        success=success,
        progress=progress,
        failure="" if success else (failures or ["time"])[0],
        peak_force=max(forces),
        mean_force=float(np.mean(forces)),
        seconds=(len(forces) - 1) / config.control_hz,
    )

"""Run a policy in a task and say how often it succeeds, with a 95 % Wilson interval."""

import os
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from touchgoal.control.errors import UserError
from touchgoal.episodes.media import write_video
from touchgoal.episodes.recording import Demonstration, demonstrate_on_film
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.policies.rollout import Trial, evaluate_expert
from touchgoal.policies.success import SuccessRate
from touchgoal.sim_envs.objects import CATALOGUE, SHAPES, find
from touchgoal.sim_envs.pick_place import PickPlace, PickPlaceConfig


@dataclass(frozen=True)
class Config:
    """Options of run-policy."""

    policy: Literal["expert"] = "expert"
    """Which policy: the scripted expert, which sees the simulator's state."""
    out: Path | None = None
    """Folder of the run."""
    episodes: int = 20
    """How many; objects are taken from the catalogue in turn."""
    objects: tuple[str, ...] = ()
    """Catalogue names; default: all."""
    seed: int = 1_000_000
    """Of the first episode; each further one adds one."""
    workers: int = os.cpu_count() or 1
    """Processes that simulate."""
    video: bool = True
    """Film the worst episode."""
    env: PickPlaceConfig = field(default_factory=lambda: PickPlaceConfig(cameras=(), tactile=False))
    """Options of the task; the expert needs no pictures."""


def main(config: Config) -> None:
    """Run the episodes, print the table, film the worst one."""
    if config.episodes < 1:
        raise UserError("nothing to run: ask for at least one episode")
    names = [find(name).name for name in config.objects] or list(CATALOGUE)
    jobs = [
        Demonstration(config.seed + i, options={"object": names[i % len(names)]})
        for i in range(config.episodes)
    ]
    out = open_run(config.out, "run-policy", config)
    trials = evaluate_expert(config.env, jobs, config.workers)
    write_json(out / "metrics.json", summary(trials))
    print(table(trials))
    if config.video:
        worst = min(range(len(trials)), key=lambda i: (trials[i].progress, -trials[i].error))
        env = PickPlace(replace(config.env, tactile=True))
        _, frames = demonstrate_on_film(env, jobs[worst])
        env.close()
        write_video(out / "worst.mp4", frames, config.env.control_hz)
        print(f"worst episode (seed {jobs[worst].seed}): {out / 'worst.mp4'}")
    print(f"all trials: {out / 'metrics.json'}")


def summary(trials: list[Trial]) -> dict:
    """What metrics.json holds."""
    rate = SuccessRate(sum(t.success for t in trials), len(trials))
    return {
        "successes": rate.successes,
        "trials": rate.trials,
        "wilson_95": rate.interval,
        "episodes": [asdict(t) for t in trials],
    }


def table(trials: list[Trial]) -> str:
    """Success by shape and in all; mass and force ranges met."""
    lines = [f"{'shape':<10}{'success [95 % Wilson]':<26}{'placing error mm':>17}"]
    for shape in (*SHAPES, "all"):
        some = [t for t in trials if shape in (t.shape, "all")]
        if some:
            rate = SuccessRate(sum(t.success for t in some), len(some))
            error = 1e3 * sum(t.error for t in some) / len(some)
            lines.append(f"{shape:<10}{rate!s:<26}{error:>17.1f}")
    masses, forces = [t.mass for t in trials], [t.grasp_force for t in trials]
    lines.append(
        f"masses {1e3 * min(masses):.0f} to {1e3 * max(masses):.0f} g, "
        f"grasp forces {min(forces):.1f} to {max(forces):.1f} N"
    )
    return "\n".join(lines)

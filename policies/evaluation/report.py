"""Record of an evaluation: each trial as it ends, the table, films of three episodes."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.control.interfaces import Actor
from touchgoal.control.tactile.light_gain import light_advice
from touchgoal.episodes.film import write_film
from touchgoal.episodes.recording import EpisodeSpec, record_with_film
from touchgoal.policies.evaluation.evaluate import REFUSED, Evaluation, Trial
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.sim_envs.config import TaskConfig
from touchgoal.sim_envs.scene.objects import SHAPES
from touchgoal.sim_envs.scene.wires import FAMILIES
from touchgoal.sim_envs.tasks import make_env

TRIALS, METRICS = "trials.jsonl", "metrics.json"


def record_trials(out: Path, trials: Iterator[Trial], count: int) -> list[Trial]:
    """Write each trial as it ends, then the metrics; print the table.

    After Ctrl-C the finished ones of `count` trials are reported, and the interruption is raised
    again.
    """
    ended: list[Trial] = []
    try:
        with open(out / TRIALS, "w") as file:
            for trial in trials:
                ended.append(trial)
                file.write(json.dumps(asdict(trial)) + "\n")
                file.flush()
    except KeyboardInterrupt:
        if not ended:
            print(f"\nstopped before the first of {count} episodes ended: nothing to keep")
            raise
        write_json(out / METRICS, _summary(ended) | {"stopped": True, "asked": count})
        print(f"\nstopped after {len(ended)} of {count} episodes: {Evaluation(tuple(ended))}")
        print(f"{table(ended)}\nkept: {out / TRIALS} and {out / METRICS}")
        raise
    write_json(out / METRICS, _summary(ended))
    print(f"{table(ended)}\nall trials: {out / METRICS}")
    return ended


def film_trials(
    out: Path,
    task: TaskConfig,
    specs: Sequence[EpisodeSpec],
    trials: Sequence[Trial],
    policy: Callable[[Any], Actor],
    workers: int,
) -> None:
    """Run the worst, the median and the best episode again, and film them into the folder `out`."""
    jobs = list(_chosen(specs, trials).items())
    with parallel_map(partial(_film, task, policy, out), jobs, workers) as filmed:
        for (name, spec), path in zip(jobs, filmed, strict=True):
            print(f"{name} episode (seed {spec.seed}): {path}")


def _chosen(specs: Sequence[EpisodeSpec], trials: Sequence[Trial]) -> dict[str, EpisodeSpec]:
    """Return worst, best and median episode, as far as there are as many.

    They are ranked by progress, then by distance from the goal or force.
    """

    def worth(ended: tuple[Trial, EpisodeSpec]) -> tuple[float, ...]:
        t = ended[0]
        return t.success, t.progress, -(t.goal_distance or 0.0), -t.peak_force

    acted = [pair for pair in zip(trials, specs, strict=True) if pair[0].failure != REFUSED]
    ranked = [spec for _, spec in sorted(acted, key=worth)]
    if not ranked:
        return {}
    chosen = {"worst": ranked[0], "best": ranked[-1], "median": ranked[len(ranked) // 2]}
    return dict(list(chosen.items())[: len(ranked)])


def _film(
    task: TaskConfig, policy: Callable[[Any], Actor], out: Path, job: tuple[str, EpisodeSpec]
) -> Path:
    name, spec = job
    env = make_env(task)  # with the same images, because rendering them draws random numbers
    episode, images = record_with_film(env, spec, policy, "fast")
    env.close()
    path = out / f"{name}.mp4"
    write_film(path, images, episode, task.control_hz)
    return path


def _summary(trials: list[Trial]) -> dict[str, Any]:
    rate = Evaluation(tuple(trials)).rate
    return {
        "successes": rate.successes,
        "trials": rate.trials,
        "wilson_95": rate.interval,
        "episodes": [asdict(t) for t in trials],
    }


_MUCH_CLAMPED = 0.05  # share of the ticks


def table(trials: Sequence[Trial]) -> str:
    """Return the table with its legend; the goal error only where the task has a goal position."""
    placed = any(t.goal_distance is not None for t in trials)
    lines = [
        f"{'':<12}{'success [95 % Wilson]':<24}{'progress':>9}{'force N, mean':>15}{'max':>7}"
        f"{'seconds':>9}" + f"{'goal error mm':>15}" * placed
    ]
    for group in (*SHAPES, *FAMILIES, "all"):
        some = [t for t in trials if group in (group_of(t), "all")]
        if some:
            lines.append(_row(group, some, placed))
    lines.append("progress: greatest share of the task done; force: external, on the hand")
    if placed:
        lines.append("goal error: distance of the object from its goal at the end")
        episodes = [t.episode for t in trials]
        masses, forces = [e["mass"] for e in episodes], [e["grasp_force"] for e in episodes]
        lines.append(
            f"objects of {1e3 * min(masses):.0f} to {1e3 * max(masses):.0f} g, gripped with "
            f"{min(forces):.1f} to {max(forces):.1f} N"
        )
    for success, what in ((True, "successes"), (False, "failures")):
        if told := Counter(t.judged for t in trials if t.judged and t.success is success):
            verdicts = ", ".join(f"{n} {verdict}" for verdict, n in told.items())
            lines.append(f"the judge says of the {told.total()} {what}: {verdicts}")
    failures = Counter(t.failure for t in trials if t.failure)
    lines.append("failures: " + (", ".join(f"{k} {n}" for k, n in failures.items()) or "none"))
    if (clamped := np.mean([t.clamped for t in trials])) > _MUCH_CLAMPED:
        lines.append(
            f"clamped: {clamped:.0%} of the actions are beyond the arm's limits; an action is the "
            "joint changes of one tick (rad) and the gripper's width (m)"
        )
    if advice := light_advice([t.light_change for t in trials]):
        lines.append(f"light: {advice}")
    return "\n".join(lines)


def group_of(trial: Trial) -> str:
    """Return the family of the trial's wire, or the shape of its object."""
    return str(trial.episode.get("family") or trial.episode["shape"])


def _row(group: str, some: list[Trial], placed: bool) -> str:
    result = Evaluation(tuple(some))
    row = (
        f"{group:<12}{result.rate!s:<24}{result.progress:>9.0%}"
        f"{np.mean([t.mean_force for t in some]):>15.1f}{max(t.peak_force for t in some):>7.1f}"
        f"{np.mean([t.seconds for t in some]):>9.1f}"
    )
    if placed:
        row += f"{1e3 * np.mean([t.goal_distance or 0.0 for t in some]):>15.1f}"
    return row

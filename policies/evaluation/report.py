"""Record of an evaluation: each trial as it ends, the table, films of three episodes."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from touchgoal.episodes.film import write_film
from touchgoal.episodes.recording import EpisodeSpec, record_with_film
from touchgoal.policies.by_name import PolicyMaker
from touchgoal.policies.evaluation.evaluate import Evaluation, Trial
from touchgoal.policies.evaluation.table import table, worst_first
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.sim_envs.config import TaskConfig
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
    policy: PolicyMaker,
    workers: int,
) -> None:
    """Run the worst, the median and the best episode again, and film them side by side."""
    ranked = [specs[i] for i in worst_first(trials)]
    chosen = {"worst": ranked[0], "best": ranked[-1], "median": ranked[len(ranked) // 2]}
    names = list(chosen)[: len(ranked)]
    paths = [out / f"{name}.mp4" for name in names]
    jobs = [(chosen[name], path) for name, path in zip(names, paths, strict=True)]
    with parallel_map(partial(_film, task, policy), jobs, workers) as filmed:
        for name, path, _ in zip(names, paths, filmed, strict=True):
            print(f"{name} episode (seed {chosen[name].seed}): {path}")


def _film(task: TaskConfig, policy: PolicyMaker, job: tuple[EpisodeSpec, Path]) -> None:
    spec, path = job
    env = make_env(task)  # with the same images, because rendering them draws random numbers
    episode, images = record_with_film(env, spec, policy, meshes="fast")
    write_film(path, images, episode, task.control_hz)
    env.close()


def _summary(trials: list[Trial]) -> dict[str, Any]:
    rate = Evaluation(tuple(trials)).rate
    return {
        "successes": rate.successes,
        "trials": rate.trials,
        "wilson_95": rate.interval,
        "episodes": [asdict(t) for t in trials],
    }

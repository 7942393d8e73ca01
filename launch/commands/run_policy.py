"""What `touchgoal run-policy` does."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from touchgoal.episodes.film import write_film
from touchgoal.episodes.recording import Actor, EpisodeSpec, record_with_film
from touchgoal.launch.run_policy import Config
from touchgoal.policies.by_name import choose_policy, env_config_for
from touchgoal.policies.evaluation.evaluate import Evaluation, Trial, run_trials, trial_specs
from touchgoal.policies.evaluation.table import table, worst_first
from touchgoal.runtime.run_folder import open_run, write_json
from touchgoal.sim_envs.config import TaskConfig
from touchgoal.sim_envs.tasks import make_env

TRIALS = "trials.jsonl"


def run_command(config: Config) -> None:
    """Run the episodes, print the table, film three of them."""
    policy = choose_policy(config.policy, config.env)
    env = env_config_for(policy, config.env)
    specs = trial_specs(env, config.episodes, config.seed)
    out = open_run(config.out, "run-policy", config)
    trials: list[Trial] = []
    try:
        with open(out / TRIALS, "w") as file:
            for trial in run_trials(env, policy, specs, config.workers):
                trials.append(trial)
                file.write(json.dumps(asdict(trial)) + "\n")
                file.flush()
    except KeyboardInterrupt:
        _stopped(out, trials, len(specs))
        raise
    write_json(out / "metrics.json", summary(trials))
    print(f"{table(trials)}\nall trials: {out / 'metrics.json'}")
    if config.video:
        _film(out, env, [specs[i] for i in worst_first(trials)], policy)


def _stopped(out: Path, trials: list[Trial], asked: int) -> None:
    """Keep and say what is done after Ctrl-C."""
    if not trials:
        print(f"\nstopped before the first of {asked} episodes ended: nothing to keep")
        return
    write_json(out / "metrics.json", summary(trials) | {"stopped": True, "asked": asked})
    print(f"\nstopped after {len(trials)} of {asked} episodes: {Evaluation(tuple(trials))}")
    print(f"{table(trials)}\nkept: {out / TRIALS} and {out / 'metrics.json'}")


def _film(
    out: Path, task: TaskConfig, ranked: list[EpisodeSpec], policy: Callable[[Any], Actor]
) -> None:
    """Films the worst episode, the median and the best; `ranked` has the worst first."""
    places = {"worst": 0, "median": len(ranked) // 2, "best": len(ranked) - 1}
    env = make_env(replace(task, tactile=True))
    for name in list(places)[: len(ranked)]:
        spec = ranked[places[name]]
        episode, pictures = record_with_film(env, spec, policy)
        write_film(out / f"{name}.mp4", pictures, episode, task.control_hz)
        print(f"{name} episode (seed {spec.seed}): {out / f'{name}.mp4'}")
    env.close()


def summary(trials: list[Trial]) -> dict[str, Any]:
    """What metrics.json holds."""
    rate = Evaluation(tuple(trials)).rate
    return {
        "successes": rate.successes,
        "trials": rate.trials,
        "wilson_95": rate.interval,
        "episodes": [asdict(t) for t in trials],
    }

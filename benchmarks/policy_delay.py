"""How often a policy succeeds when what it sees, plans and commands comes late, in the environment.

The arm is as deployed otherwise: `--env.as-deployed` with other delays. The same seeds in every row.
"""

from dataclasses import asdict, replace
from typing import Any

from touchgoal.benchmarks.config import PolicyDelayOptions
from touchgoal.policies.by_name import choose_policy, env_config_for
from touchgoal.policies.evaluation.evaluate import Evaluation, run_trials, trial_specs
from touchgoal.sim_envs.config import BeadMazeConfig, DeploymentConfig, PickPlaceConfig, TaskConfig


def run(config: PolicyDelayOptions) -> dict[str, Any]:
    """Success by delay, jitter and picture rate; `table` and the trials behind it."""
    lines = [
        f"{'delay ms':>8}{'jitter ms':>11}{'pictures Hz':>13}   success [95 % Wilson]   peak N"
    ]
    rows = []
    for rate in config.rates:
        for jitter in config.jitter:
            for delay in config.delay:
                row = _row(config, delay, jitter, rate)
                lines.append(row.pop("line"))
                print(lines[-1], flush=True)
                rows.append(row)
    return {"table": "\n".join(lines), "rows": rows}


def _row(config: PolicyDelayOptions, delay: float, jitter: float, rate: float) -> dict[str, Any]:
    half = (
        delay / 2000,
        delay / 2000,
    )  # s: half of it on the way to the policy, half on the way back
    between = DeploymentConfig(
        state_delay=half,
        picture_delay=half,
        command_delay=half,
        jitter=(jitter / 1000, jitter / 1000),
        picture_rate=rate,
    )
    task: TaskConfig = PickPlaceConfig()
    if config.task == "bead-maze":
        task = BeadMazeConfig(split="validation")
    task = replace(task, as_deployed=True, deployment=between)
    policy = choose_policy(config.policy, task)
    task = env_config_for(policy, task)
    specs = trial_specs(task, config.episodes, config.seed)
    result = Evaluation(tuple(run_trials(task, policy, specs, config.workers)))
    peak = max(trial.peak_force for trial in result.trials)
    line = f"{delay:>8.0f}{jitter:>11.0f}{rate:>13.0f}   {result!s:<24}{peak:>6.0f}"
    return {
        "line": line,
        "delay_ms": delay,
        "jitter_ms": jitter,
        "picture_rate": rate,
        "trials": [asdict(trial) for trial in result.trials],
    }

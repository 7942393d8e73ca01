"""Run a policy in a task and print its success rate, with a 95 % Wilson interval."""

import os
import shlex
from dataclasses import is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

from touchgoal.control.cell.config import SimulatedTask
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import ENVS, TaskConfig, TaskName


@checked_dataclass
class Config:
    """Options of run-policy."""

    task: TaskName = "pick-place"
    """Task to run it in."""
    policy: str = "shipped"
    """Policy: shipped; a folder that train-policy made; expert, which sees the simulator's state;
    follower (bead-maze), classical control from the force on the hand; a class of your own, as
    module:Class or file.py:Class, or an openpi server, as ws://host:port (docs/own_policy.md)."""
    target: str | None = None
    """Object to pick up where --env.distractors lie beside it, in words, such as "the red block";
    {object} in it is the name of each episode's object."""
    out: Path | None = None
    """Folder of the run."""
    episodes: Count = 20
    """Number of episodes; objects are taken in turn, wires one each."""
    seed: Seed = seeds.EVALUATION.start
    """Random seed of the first episode; each further one adds one."""
    workers: Count = os.cpu_count() or 1
    """Processes that simulate."""
    ray: str | None = None
    """Address of a Ray cluster whose cores work in place of --workers; auto: one started on this machine."""
    judge: str | None = None
    """Folder of fit-normalizer --judge, or gelsight_mini for the one that ships: its judge ends episodes
    and judges them beside the simulator, after a second of rest."""
    video: bool = True
    """Film the worst, the median and the best episode."""
    env: TaskConfig = ENVS["pick-place"]
    """Options of the task. Only images that the policy reads are rendered."""


def main(config: Config) -> None:
    """Run the episodes, print the table, film three of them."""
    from touchgoal.policies.by_name import prepare_policy
    from touchgoal.policies.checkpoint import EPISODE_OBJECT
    from touchgoal.policies.evaluation.evaluate import run_trials, trial_specs
    from touchgoal.policies.evaluation.report import film_trials, record_trials
    from touchgoal.runtime.run_folder import open_run

    policy, env = prepare_policy(config.policy, config.env, config.target)
    judge = None
    if config.judge is not None:
        from touchgoal.rewards.reward_wrapper import RunJudge

        judge = partial(RunJudge, config.judge)
        env = replace(env, rest=1.0, tactile=True, cameras=config.env.cameras)
    specs = trial_specs(env, config.episodes, config.seed)
    out = open_run(config.out, "run-policy", replace(config, env=env))
    trials = run_trials(env, policy, specs, config.ray or config.workers, judge)
    trials = record_trials(out, trials, len(specs))
    if config.video:
        film_trials(out, env, specs, trials, policy, config.workers)
    if config.task not in get_args(SimulatedTask):
        return
    cell = "sim" if config.task == "pick-place" else "sim_maze"
    if changed := _changed_options(config.env, ENVS[config.task]):
        print(
            f"next, serve this task: touchgoal twin --task {config.task} {changed} --out runs/twin"
        )
        cell = "runs/twin/cell.json"
    command = f"touchgoal deploy {cell} --execute --policy {shlex.quote(config.policy)}"
    if config.target and EPISODE_OBJECT not in config.target:
        command += f" --target {shlex.quote(config.target)}"
    when = "then, in another terminal" if changed else "next"
    print(f"{when}, by the control loop that also drives a real arm: {command}")


def _changed_options(given: object, default: object, above: str = "") -> str:
    """Return the options that differ from the default ones, as typed."""
    from touchgoal.policies.by_name import typed_option

    return " ".join(
        _changed_options(value, usual, f"{above}{name}.")
        if is_dataclass(value)
        else typed_option(above + name, value)
        for (name, value), usual in zip(vars(given).items(), vars(default).values(), strict=True)
        if value != usual
    )

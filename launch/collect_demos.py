"""Record an expert's episodes of a task, or failures on purpose, as a LeRobot v3 data set."""

import os
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

from touchgoal.runtime.option_types import Count, Seed, checked_dataclass
from touchgoal.sim_envs.config import (
    BeadMazeConfig,
    FragileCarryConfig,
    Outcome,
    PickPlaceConfig,
    TaskConfig,
    TaskName,
)

ENVS: dict[TaskName, TaskConfig] = {
    "pick-place": PickPlaceConfig(),
    "bead-maze": BeadMazeConfig(disturbance=0.004),  # demonstrates recovery
    "fragile-carry": FragileCarryConfig(disturbance=0.003),
}
"""Default options of each task's environment."""
NO_SUCCESS = 3  # exit status
_MAX_FAILURES = 10


@checked_dataclass
class Config:
    """Options of collect-demos."""

    task: TaskName = "pick-place"
    """Task to demonstrate."""
    out: Path | None = None
    """Folder of the run; episodes are appended to its `episodes/`. Seeds that it holds are skipped, so
    the same command continues an interrupted recording."""
    episodes: Count = 10
    """Number of episodes of each outcome."""
    outcomes: tuple[Outcome, ...] = ("success",)
    """Outcomes to ask the expert for; pick-place has poor successes and failures on purpose, too. An
    episode that ends otherwise is recorded with outcome `not_` and the name."""
    feedback: bool = False
    """pick-place: the expert reacts to every tick's state; policies learn better from that."""
    policy: str | None = None
    """Policy that acts while the expert's actions are recorded (DAgger), named as for run-policy."""
    seed: Seed = 0
    """Random seed of the first episode; each further one adds one."""
    shard: str = "0/1"
    """Record part I of N, as I/N counted from 0: 0/4 to 3/4 on four machines, each with its own --out.
    Together they are the episodes that one run records; --data 'runs/large/*' opens all as one."""
    workers: Count = os.cpu_count() or 1
    """Number of simulating processes."""
    ray: str | None = None
    """Address of a Ray cluster whose cores work in place of --workers; auto: one started on this machine."""
    env: TaskConfig = ENVS["pick-place"]
    """Options of the task; its objects or wires are taken in turn."""


def main(config: Config) -> None:
    """Record the episodes and print how many of each outcome there are."""
    from touchgoal.episodes import recording
    from touchgoal.episodes.store import EpisodeSet
    from touchgoal.policies.evaluation.success_rate import SuccessRate
    from touchgoal.policies.training.dagger import dagger_roles
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.interruption import on_interruption
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.parallel.shard import parse_shard
    from touchgoal.runtime.run_folder import open_run

    roles, acts = recording.expert_alone, config.policy not in (None, "expert")
    if config.feedback or config.policy is not None:
        if config.outcomes != ("success",):
            message = "--outcomes needs the planned expert: leave out --feedback and --policy"
            raise UserError(message)
        roles = dagger_roles(config.policy, config.env, config.feedback)
    shard = parse_shard(config.shard, config.episodes)
    whole = config.env, config.outcomes, config.episodes, config.seed
    specs = recording.episode_specs(*whole, shard)
    out = open_run(config.out, "collect-demos", config, adds=True)
    root = out / "episodes"
    missing = recording.missing_specs(root, specs, corrected=acts)
    if len(missing) < len(specs):
        print(f"{len(specs) - len(missing)} of {len(specs)} seeds are recorded in {root}: skipped")
    if not missing:
        next_seed = config.seed + config.episodes * len(config.outcomes)
        print(f"nothing left to record: {len(EpisodeSet(root))} episodes; more: --seed {next_seed}")
        return
    most = None if acts else _MAX_FAILURES
    kept = f"finished episodes are in {root}; the same command with --out {out} continues"
    try:
        with on_interruption(lambda: kept):
            # the maze's success is 3 cm before its post; the expert leads the bead on and presses it there
            env = replace(config.env, ends_by_success=config.task != "bead-maze")
            metas = recording.collect(root, env, missing, config.ray or config.workers, roles, most)
    except recording.NoSuccessError as error:
        print(f"{error}; look at one: touchgoal run-policy --task {config.task}", file=sys.stderr)
        sys.exit(NO_SUCCESS)
    outcomes = Counter(str(meta["outcome"]) for meta in metas)
    write_json(out / "metrics.json", {"outcomes": outcomes, "episodes": metas})
    print(f"{len(metas)} episodes recorded, {len(EpisodeSet(root))} in {root}")
    for outcome, count in outcomes.items():
        print(f"  {outcome:<20}{count}")
    if acts:
        rate = SuccessRate(sum(bool(meta["success"]) for meta in metas), len(metas))
        print(f"the policy succeeded in {rate}")

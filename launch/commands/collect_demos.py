"""What `touchgoal collect-demos` does."""

import shlex
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from touchgoal.episodes.recording import EpisodeSpec, Roles, collect, expert_alone
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.collect_demos import Config
from touchgoal.policies.by_name import choose_policy, env_config_for
from touchgoal.policies.checkpoint import SavedPolicy, load
from touchgoal.policies.evaluation.success_rate import SuccessRate
from touchgoal.policies.training.dagger import DaggerRoles
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.run_folder import open_run, write_json
from touchgoal.sim_envs.config import (
    BeadMazeConfig,
    PickPlaceConfig,
    TaskConfig,
)
from touchgoal.sim_envs.scene.objects import CATALOGUE


def run_command(config: Config) -> None:
    """Record the episodes and say what came of them."""
    roles = _roles(config)
    specs = specs_of(config)
    if config.resume:
        specs = _missing(config, specs)
    out = open_run(config.out, "collect-demos", config, adds=True)
    try:
        metas = collect(out / "episodes", config.env, specs, config.workers, roles)
    except KeyboardInterrupt:
        _stopped(out, config)
        raise
    outcomes = Counter(str(meta["outcome"]) for meta in metas)
    write_json(out / "metrics.json", {"outcomes": outcomes, "episodes": metas})
    print(f"{len(metas)} episodes in {out / 'episodes'}")
    for outcome, count in outcomes.items():
        print(f"  {outcome:<14}{count}")
    if config.policy:
        rate = SuccessRate(sum(bool(meta["success"]) for meta in metas), len(metas))
        print(f"the policy succeeded in {rate}")


def specs_of(config: Config) -> list[EpisodeSpec]:
    """The episodes to record: with each object (or wire) in turn, every outcome once."""
    kinds, options = config.outcomes, _reset_options(config.env)
    return [
        EpisodeSpec(config.seed + i, kinds[i % len(kinds)], options[i // len(kinds) % len(options)])
        for i in range(len(kinds) * config.episodes)
    ]


def _missing(config: Config, specs: list[EpisodeSpec]) -> list[EpisodeSpec]:
    """The episodes that the set in `out` does not hold yet."""
    if config.out is None:
        raise UserError("to go on with a recording, name its folder with --out")
    if not (config.out / "episodes").is_dir():
        return specs
    kept = EpisodeSet(config.out / "episodes")
    seeds = [kept.meta(i)["seed"] for i in range(len(kept))]
    missing = [spec for spec in specs if spec.seed not in seeds]
    if not missing:
        raise UserError(f"all {len(specs)} episodes are in {config.out / 'episodes'} already")
    return missing


def _stopped(out: Path, config: Config) -> None:
    """Say after Ctrl-C what is kept, and how to go on."""
    root = out / "episodes"
    if not root.exists():
        print("\nstopped before the first episode was recorded: nothing to keep")
        return
    kept = len(EpisodeSet(root))
    many = "1 episode is" if kept == 1 else f"{kept} episodes are"
    print(f"\nstopped: {many} kept in {root}, whole and sound. To go on:")
    rest = [] if config.out else ["--out", str(out)]
    rest += [] if config.resume else ["--resume"]
    print("  " + shlex.join(["touchgoal", *sys.argv[1:], *rest]))


def _reset_options(env: TaskConfig) -> list[dict[str, Any]]:
    """The reset options that the episodes take in turn."""
    if isinstance(env, BeadMazeConfig):
        return [{"wire": wire.name} for wire in env.chosen_wires()]
    return [{"object": name} for name in env.objects or CATALOGUE]


def _roles(config: Config) -> Roles:
    """Who acts and who answers; UserError for a policy that cannot act in the task."""
    task = config.env
    if isinstance(task, BeadMazeConfig) and config.feedback:
        raise UserError("--feedback is for pick-place: the bead maze's expert always decides anew")
    if not config.feedback and config.policy is None:
        return expert_alone
    if config.outcomes != ("success",) or (isinstance(task, PickPlaceConfig) and task.release):
        raise UserError(
            "an expert that is asked at every tick neither fails on purpose nor lets go: leave out "
            "--outcomes, --env.release, or --feedback and --policy"
        )
    if config.policy is None or config.policy == "expert":
        return DaggerRoles()
    policy = choose_policy(config.policy, task)  # wrong ones are refused before anything is written
    needed = env_config_for(policy, task)
    knows_truth = isinstance(policy, SavedPolicy) and load(policy.directory).config.estimated
    if not knows_truth:
        missing = [f"the {name} camera" for name in needed.cameras if name not in task.cameras]
        missing += ["the fingertips"] * (needed.tactile and not task.tactile)
        if missing:
            raise UserError(
                f"the policy looks at {missing[0]}: record that too (--env.cameras, --env.tactile)"
            )
    return DaggerRoles(policy)

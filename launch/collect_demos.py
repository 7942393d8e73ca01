"""Record expert episodes of pick-and-place, or failures to order, as a LeRobot-v3 data set."""

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from touchgoal.episodes.recording import Demonstration, collect
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.sim_envs.experts import Outcome
from touchgoal.sim_envs.objects import CATALOGUE, find
from touchgoal.sim_envs.pick_place import PickPlaceConfig


@dataclass(frozen=True)
class Config:
    """Options of collect-demos."""

    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`, after those already there."""
    episodes: int = 10
    """How many of each outcome."""
    outcomes: tuple[Outcome, ...] = ("success",)
    """What the expert shall do: succeed, or fail in one of four ways."""
    objects: tuple[str, ...] = ()
    """Catalogue names, taken in turn; default: all."""
    seed: int = 0
    """Of the first episode; each further one adds one."""
    workers: int = os.cpu_count() or 1
    """Processes that simulate."""
    env: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    """Options of the task."""


def main(config: Config) -> None:
    """Record the episodes and say what came of them."""
    names = [find(name).name for name in config.objects] or list(CATALOGUE)
    demonstrations = [
        Demonstration(config.seed + i, outcome, {"object": names[i % len(names)]})
        for i, outcome in enumerate(config.outcomes * config.episodes)
    ]
    out = open_run(config.out, "collect-demos", config)
    metas = collect(out / "episodes", config.env, demonstrations, config.workers)
    outcomes = Counter(str(meta["outcome"]) for meta in metas)
    write_json(out / "metrics.json", {"outcomes": outcomes, "episodes": metas})
    print(f"{len(metas)} episodes in {out / 'episodes'}")
    for outcome, count in outcomes.items():
        print(f"  {outcome:<14}{count}")

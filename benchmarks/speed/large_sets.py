"""Processor time of a growing set of episodes: the first thousand against the last.

    python -m benchmarks.speed.large_sets --episodes 20000 --root /dev/shm/large_set

Episodes have two frames and no pictures. Times are the process's own, s; opening and checking are divided
by the thousands in the set.
"""

import resource
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from pydantic import Field

from touchgoal.control import features as ft
from touchgoal.episodes.format.encoding import encode
from touchgoal.episodes.format.repair import validate
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, checked_dataclass

_READS = 200


@checked_dataclass
class Config:
    """Options of the measurement."""

    root: Path
    """New folder of the set, best in memory, where writing waits for no disk."""
    episodes: Annotated[int, Field(ge=2)] = 20_000
    """Episodes in the end."""
    step: Count = 1000
    """Episodes of a row."""


def main(config: Config) -> None:
    """Append, and measure after the first and the last step."""
    if config.root.exists():
        raise UserError(f"{config.root} exists: name a new folder")
    numbers = {ft.STATE: np.zeros((2, 15), np.float32), ft.ACTION: np.zeros((2, 8), np.float32)}
    episode = encode(Episode(numbers, "stand still", {"success": True}), 20)
    print(
        f"{'episodes':>9}{'append':>9}{'open':>9}{'read 200':>9}{'validate':>9}{'memory, GB':>12}"
    )
    with closing(EpisodeWriter(config.root)) as writer:
        while len(writer) < config.episodes:
            appended = _seconds(lambda: [writer.append(episode) for _ in range(config.step)])
            print(f"{len(writer):>9}{appended:>9.2f}", end="", flush=True)
            if len(writer) in (config.step, config.episodes):
                print("".join(f"{value:>9.3f}" for value in _use(config)), end="")
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
                print(f"{peak:>12.2f}", end="")
            print()


def _use(config: Config) -> tuple[float, float, float]:
    """Return the seconds of opening and of checking, a step's episodes each, and of reading."""
    episodes = EpisodeSet(config.root)
    steps = len(episodes) / config.step
    rows = np.random.default_rng(0).integers(0, len(episodes), _READS).tolist()
    opened = min(_seconds(lambda: EpisodeSet(config.root)) for _ in range(3))
    read = min(_seconds(lambda: [episodes.read(row) for row in rows]) for _ in range(3))
    return opened / steps, read, _seconds(lambda: validate(config.root)) / steps


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


if __name__ == "__main__":
    main(tyro.cli(Config))

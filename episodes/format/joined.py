"""Sets of episodes read as one, such as the shards of a recording."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, reduce, wraps
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.episodes.format import remote
from touchgoal.episodes.format.metadata import differing_features
from touchgoal.episodes.format.statistics import Stats, merge
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError


def _answered_by_part(method: Callable[..., Any]) -> Any:
    """Return a method that asks the set that holds episode i."""

    @wraps(method)
    def ask(self: "JoinedSet", i: int, *arguments: Any, **options: Any) -> Any:
        one, number = self.part(i)
        return method(one, number, *arguments, **options)

    return ask


class JoinedSet(EpisodeSet):
    """Episodes of several sets, in the order of the sets; see `EpisodeSet` for the methods."""

    def __init__(self, root: Path, sets: Sequence[EpisodeSet]) -> None:
        """Join sets; `root` names them in messages. UserError: their rates or features differ."""
        first = sets[0]
        for other in sets[1:]:
            _require_alike(first, other)
        self.root, self.fps, self.keys, self.features = root, first.fps, first.keys, first.features
        self.sets = tuple(sets)
        self.foreign = any(one.foreign for one in sets)
        self.lengths = [length for one in sets for length in one.lengths]
        self._ends = np.cumsum([len(one) for one in sets])

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the checksums of the sets."""
        content = json.dumps([one.checksum for one in self.sets])
        return hashlib.sha256(content.encode()).hexdigest()

    @cached_property
    def stats(self) -> dict[str, Stats]:
        """Statistics over the frames of all sets; see `merge` for the quantiles."""
        parts = [one.stats for one in self.sets]
        common = [key for key in parts[0] if all(key in part for part in parts)]
        return {key: reduce(merge, (part[key] for part in parts)) for key in common}

    def part(self, i: int) -> tuple[EpisodeSet, int]:
        """Return the set that holds episode i, and its index there."""
        number = int(np.searchsorted(self._ends, self._checked(i), side="right"))
        one = self.sets[number]
        return one, i - int(self._ends[number]) + len(one)

    episode_checksum = _answered_by_part(EpisodeSet.episode_checksum)
    frame_checksums = _answered_by_part(EpisodeSet.frame_checksums)
    meta = _answered_by_part(EpisodeSet.meta)
    task = _answered_by_part(EpisodeSet.task)
    stored_numbers = _answered_by_part(EpisodeSet.stored_numbers)
    video_length = _answered_by_part(EpisodeSet.video_length)
    read = _answered_by_part(EpisodeSet.read)


def _require_alike(first: EpisodeSet, other: EpisodeSet) -> None:
    """Raise UserError if two sets cannot be read as one."""
    differing = differing_features(first.features, other.features)
    if first.fps != other.fps or differing:
        raise UserError(
            f"{first.root} and {other.root} differ in {(differing or ['rate'])[0]}: open sets "
            "recorded with the same options together"
        )


def load_episodes(
    path: str | os.PathLike[str], keys: Mapping[str, str] | None = None
) -> EpisodeSet:
    """Open a set of episodes that touchgoal or lerobot wrote, see `EpisodeSet`, or many as one.

    episodes = touchgoal.load_episodes("s3://bucket/set", {"observation.images.top": ft.FRONT})
    episodes.read(0).frames[ft.FRONT]  # (T, height, width, 3)
    touchgoal.load_episodes("runs/large/*")  # all sets, or runs, in runs/large
    """
    sets = [EpisodeSet(folder, keys=keys) for folder in remote.matching_folders(Path(path))]
    return sets[0] if len(sets) == 1 else JoinedSet(Path(path), sets)

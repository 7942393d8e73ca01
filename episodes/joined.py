"""Sets of episodes read as one, such as the shards of a recording."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from functools import cached_property, reduce
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from touchgoal.episodes.format import remote
from touchgoal.episodes.format.statistics import Stats, merge
from touchgoal.episodes.schema import Episode, MetaValue
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError


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
        self._lengths = [length for one in sets for length in one.lengths]
        self._ends = np.cumsum([len(one) for one in sets])

    def __len__(self) -> int:
        return len(self._lengths)

    @property
    def lengths(self) -> list[int]:
        """Number of frames of every episode."""
        return self._lengths

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

    def episode_checksum(self, i: int) -> str:
        """See EpisodeSet."""
        one, i = self.part(i)
        return one.episode_checksum(i)

    def frame_checksums(self, i: int, key: str) -> frozenset[int]:
        """See EpisodeSet."""
        one, i = self.part(i)
        return one.frame_checksums(i, key)

    def meta(self, i: int) -> dict[str, MetaValue]:
        """See EpisodeSet."""
        one, i = self.part(i)
        return one.meta(i)

    def task(self, i: int) -> str:
        """See EpisodeSet."""
        one, i = self.part(i)
        return one.task(i)

    def stored_numbers(self, i: int, key: str) -> Shaped[np.ndarray, "n d"]:
        """See EpisodeSet."""
        one, i = self.part(i)
        return one.stored_numbers(i, key)

    def video_length(self, i: int, key: str) -> tuple[int, int, float]:
        """See EpisodeSet."""
        one, i = self.part(i)
        return one.video_length(i, key)

    def read(
        self, i: int, keys: Sequence[str] | None = None, frames: Sequence[int] | None = None
    ) -> Episode:
        """See EpisodeSet."""
        one, i = self.part(i)
        return one.read(i, keys, frames)


def _require_alike(first: EpisodeSet, other: EpisodeSet) -> None:
    """Raise UserError if two sets cannot be read as one."""
    if first.fps != other.fps:
        raise UserError(
            f"{first.root} runs at {first.fps} frames per second, {other.root} at {other.fps}: open "
            "sets of one rate together"
        )
    for key in sorted({*first.features, *other.features}):
        one, two = (each.features.get(key, {}) for each in (first, other))
        if (one.get("dtype"), one.get("shape")) != (two.get("dtype"), two.get("shape")):
            raise UserError(
                f"{first.root} and {other.root} differ in {key}, its presence or shape: open sets "
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

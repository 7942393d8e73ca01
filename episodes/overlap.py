"""Training and validation data that share frames, recognised by content, whatever the order."""

from collections import Counter
from collections.abc import Iterable

from touchgoal.control.features import STATE, TACTILE
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_SHARED_FRACTION = 0.1  # least share in copies; simulated episodes may begin alike
NamedChecksums = tuple[str, frozenset[int]]
"""A recording's name for messages, and the checksums of all its frames."""


def require_no_shared_frames(train: EpisodeSet, validation: EpisodeSet) -> None:
    """Compare two sets frame by frame: robot state if both have it, else tactile images.

    UserError: an episode of `validation` contains frames of an episode of `train`.
    """
    common = [k for k in (STATE, *TACTILE) if {k} <= train.features.keys() & validation.features]
    if common:
        require_disjoint(_checksums(train, common[0]), _checksums(validation, common[0]))


def _checksums(episodes: EpisodeSet, key: str) -> Iterable[NamedChecksums]:
    for i in track(range(len(episodes)), "comparing frames", "episode"):
        yield f"episode {i} of {episodes.root}", episodes.frame_checksums(i, key)


def require_disjoint(train: Iterable[NamedChecksums], validation: Iterable[NamedChecksums]) -> None:
    """Raise UserError if a recording of `validation` contains frames of one of `train`."""
    names, sizes, recordings_of = [], [], {}
    for i, (name, checksums) in enumerate(train):
        names.append(name)
        sizes.append(len(checksums))
        for checksum in checksums:
            recordings_of.setdefault(checksum, []).append(i)
    for name, checksums in validation:
        shared = Counter(i for checksum in checksums for i in recordings_of.get(checksum, ()))
        for i, count in shared.most_common():
            smaller = min(len(checksums), sizes[i])
            if count >= min(smaller, max(2, _SHARED_FRACTION * smaller)):
                raise UserError(
                    f"{name} shares {count} frames with {names[i]}: validate on episodes that are "
                    "not trained on"
                )

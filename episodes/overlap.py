"""Training and validation data that share frames, recognised by content.

Names, order and stride do not matter: a validation set of every second training frame is refused.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

from touchgoal.control.features import STATE, TACTILE
from touchgoal.episodes.store import EpisodeSet
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

# Simulated episodes may begin with the same resting frames; above this share they are copies.
_SHARED_FRACTION = 0.1


@runtime_checkable
class ChecksummedRecording(Protocol):
    """A recording whose frames have checksums."""

    @property
    def name(self) -> str:
        """Name for messages."""
        ...

    def frame_checksums(self) -> frozenset[int]:
        """Return the checksums of all frames."""
        ...


def require_no_shared_frames(train: EpisodeSet, validation: EpisodeSet) -> None:
    """Compare two sets frame by frame: robot state if both have it, else tactile images.

    UserError: an episode of `validation` contains frames of an episode of `train`.
    """
    common = [k for k in (STATE, *TACTILE) if {k} <= train.features.keys() & validation.features]
    if common:
        _compare(_checksums(train, common[0]), _checksums(validation, common[0]))


def require_no_shared_recordings(
    train: Sequence[ChecksummedRecording], validation: Sequence[ChecksummedRecording]
) -> None:
    """Compare recordings frame by frame; errors as in `require_no_shared_frames`."""
    _compare(
        ((recording.name, recording.frame_checksums()) for recording in train),
        ((recording.name, recording.frame_checksums()) for recording in validation),
    )


def _checksums(episodes: EpisodeSet, key: str) -> Iterable[tuple[str, frozenset[int]]]:
    for i in track(range(len(episodes)), "comparing frames", "episode"):
        yield f"episode {i} of {episodes.root}", episodes.frame_checksums(i, key)


def _compare(
    train: Iterable[tuple[str, frozenset[int]]], validation: Iterable[tuple[str, frozenset[int]]]
) -> None:
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

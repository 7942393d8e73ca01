"""Trajectories of a source before they are read."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from touchgoal.episodes.schema import Episode, MetaValue
from touchgoal.rewards.goals import Inputs

_CHUNK_BYTES = 48e6  # decoded frames in a chunk; a few chunks are in memory at once
_FEWEST_FRAMES = 16  # in a chunk: the first one holds the frames that give the background


@runtime_checkable  # beartype checks arguments in tests
class Trajectory(Protocol):
    """A recording that is not read yet."""

    @property
    def name(self) -> str:
        """File name of its reports, unique within the source: "episode_003"."""
        ...

    @property
    def source(self) -> str:
        """Name for people: "pick#3"."""
        ...

    @property
    def index(self) -> int:
        """Number within the set or folder."""
        ...

    @property
    def offset(self) -> int:
        """Number of frames of the set or folder that come before it."""
        ...

    @property
    def length(self) -> int:
        """Number of frames."""
        ...

    @property
    def fps(self) -> float:
        """Frames per second."""
        ...

    @property
    def meta(self) -> Mapping[str, MetaValue]:
        """Facts such as object and outcome, as far as they are recorded."""
        ...

    def checksum(self) -> str:
        """Return a text that changes when the recording does."""
        ...

    def chunks(self) -> Iterator[Episode]:
        """Read consecutive frames. UserError: a file is missing or unreadable."""
        ...


@dataclass(frozen=True)
class Skipped:
    """A trajectory that was not measured."""

    name: str
    reason: str


@dataclass(frozen=True)
class Source:
    """The trajectories of a set of episodes, a video or a folder."""

    inputs: Inputs  # everything known about them before they are read
    trajectories: Sequence[Trajectory]
    skipped: Sequence[Skipped]  # the broken ones found so far
    summary: str = ""  # for people; empty for a set of episodes under its own name


def frames_per_chunk(frame_bytes: int) -> int:
    """Return how many frames of this size, all pictures together, are read at once."""
    return max(int(_CHUNK_BYTES / max(frame_bytes, 1)), _FEWEST_FRAMES)

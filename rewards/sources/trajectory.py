"""Trajectories of a source before they are read, and chunks of them, read ahead by threads."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from touchgoal.control.arrays import Images
from touchgoal.episodes.schema import Episode, MetaValue
from touchgoal.rewards.goals import Inputs

_CHUNK_BYTES = 48e6  # decoded frames in a chunk; a few chunks are in memory at once
_THREADS = 2  # that read ahead
_FEWEST_FRAMES = 16  # in a chunk: the first one holds the frames that give the background


@dataclass(frozen=True, eq=False)
class Trajectory(ABC):
    """A recording that is not read yet."""

    name: str  # file name of its reports, unique within the source: "episode_003"
    source: str  # name for people: "pick#3"
    index: int  # number within the set or folder
    offset: int  # number of frames of the set or folder that come before it
    length: int  # number of frames
    fps: float  # frames per second
    meta: Mapping[str, MetaValue]  # facts such as object and outcome, as far as they are recorded
    # untouched frames of the fingertips, by key, where they were recorded apart
    untouched: Mapping[str, Images] = field(default_factory=dict, kw_only=True)

    @abstractmethod
    def checksum(self) -> str:
        """Return a text that changes when the recording does."""

    @abstractmethod
    def chunks(self) -> Iterator[Episode]:
        """Read consecutive frames. UserError: a file is missing or unreadable."""


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
    """Return how many frames of this size, all images together, are read at once."""
    return max(int(_CHUNK_BYTES / max(frame_bytes, 1)), _FEWEST_FRAMES)


def read_ahead(trajectories: Iterable[Trajectory]) -> Iterator[Iterator[Episode]]:
    """Yield the chunks of each trajectory, while threads read the next ones.

    At most three trajectories have a chunk in memory, and the first of them two.
    """
    with ThreadPoolExecutor(_THREADS) as pool:
        waiting: deque[Iterator[Episode]] = deque()
        for trajectory in trajectories:
            chunks = trajectory.chunks()
            waiting.append(_read_on(pool.submit(next, chunks, None), chunks, pool))
            if len(waiting) > _THREADS:
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()


def _read_on(
    following: Future[Episode | None], chunks: Iterator[Episode], pool: ThreadPoolExecutor
) -> Iterator[Episode]:
    while (chunk := following.result()) is not None:
        following = pool.submit(next, chunks, None)
        yield chunk

"""Chunks of trajectories, read ahead by threads."""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from touchgoal.episodes.schema import Episode
from touchgoal.rewards.sources.trajectory import Trajectory


class ReadAhead(Iterator[Episode]):
    """Chunks of a trajectory, of which the next one is read by a thread in the meantime."""

    def __init__(self, chunks: Iterator[Episode], pool: ThreadPoolExecutor) -> None:
        self._chunks, self._pool = chunks, pool
        self._next: Future[Episode | None] = pool.submit(next, chunks, None)

    def __next__(self) -> Episode:
        chunk = self._next.result()
        if chunk is None:
            raise StopIteration
        self._next = self._pool.submit(next, self._chunks, None)
        return chunk


def read_ahead(
    trajectories: Iterable[Trajectory], workers: int
) -> Iterator[tuple[Trajectory, Iterator[Episode]]]:
    """Yield each trajectory with its chunks, while threads read the next ones.

    At most `workers` + 1 trajectories have a chunk in memory, and the first of them two.
    """
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[tuple[Trajectory, Iterator[Episode]]] = deque()
        for trajectory in trajectories:
            waiting.append((trajectory, ReadAhead(trajectory.chunks(), pool)))
            if len(waiting) > workers:
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()

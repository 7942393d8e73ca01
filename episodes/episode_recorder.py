"""An episode that goes to disk tick by tick, so that memory does not grow with its length."""

import tempfile
import threading
from pathlib import Path
from queue import Full, Queue
from typing import IO

import numpy as np

from touchgoal.control.features import COST
from touchgoal.episodes.schema import Episode, MetaValue
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.runtime.errors import UserError

_BACKLOG = 100  # ticks that wait for the disk, at most: 5 s at 20 Hz


class EpisodeRecorder:
    """Recorder (`session.Recorder`) of one episode of a set.

    A thread writes the ticks as they are into nameless files beside the set, which a crash removes.
    """

    def __init__(self, root: Path, fps: int) -> None:
        """Begin an episode of the set in `root`."""
        self._root, self._fps, self._ticks, self._failure = root, fps, 0, ""
        self._files: dict[str, tuple[IO[bytes], np.dtype, tuple[int, ...]]] = {}
        self._queue: Queue[dict[str, np.ndarray] | None] = Queue(_BACKLOG)
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    def add(self, tick: dict[str, np.ndarray]) -> None:
        """Take a tick, whose arrays must not change any more; `save` says what failed."""
        try:
            self._queue.put_nowait(tick)
        except Full:
            self._failure = "the disk is slower than the recording: use a faster one"

    def save(self, task: str, meta: dict[str, MetaValue]) -> int:
        """Add the ticks to the set as an episode and return its index; OSError or UserError if not."""
        self._end()
        if self._failure:
            raise UserError(self._failure)
        frames: dict[str, np.ndarray] = {
            key: np.memmap(file, dtype, "r", shape=(self._ticks, *shape))
            for key, (file, dtype, shape) in self._files.items()
        }
        writer = EpisodeWriter(self._root, self._fps)
        if writer.metadata and COST not in writer.metadata.features:
            frames.pop(COST, None)  # a run goes beside demonstrations, which have no cost
        return writer.append(Episode(frames, task, meta))

    def close(self) -> None:
        """Drop what was not saved."""
        self._end()
        self._files.clear()

    def _end(self) -> None:
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def _write(self) -> None:
        while (tick := self._queue.get()) is not None:
            try:
                if not self._failure:
                    self._write_tick(tick)
            except Exception as error:
                self._failure = f"{self._root.parent}: {error}"

    def _write_tick(self, tick: dict[str, np.ndarray]) -> None:
        folder = self._root.parent
        folder.mkdir(parents=True, exist_ok=True)
        for key, value in tick.items():
            if key not in self._files:
                self._files[key] = tempfile.TemporaryFile(dir=folder), value.dtype, value.shape
            file, dtype, shape = self._files[key]
            if (value.dtype, value.shape) != (dtype, shape):
                raise UserError(f"{key} is {value.shape} in one tick and {shape} in another")
            file.write(np.ascontiguousarray(value).tobytes())
        self._ticks += 1

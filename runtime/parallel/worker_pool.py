"""Worker processes of one core each that end with the process that started them."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess

import cv2

_LOOK = 1.0  # s between two looks at the workers


class WorkerPool(ProcessPoolExecutor):
    """Processes of one core each; the death of one in the middle of a result is noticed, too.

    Python's pool would wait for the rest of that result, because it holds the pipe's other end itself; and
    at its end for the others, because a worker that dies while it waits for work keeps the queue locked.
    """

    def __init__(self, workers: int) -> None:
        # OpenGL contexts do not survive a fork, so workers are forked from a server that never
        # renders; it imports once what this process has imported
        forkserver = multiprocessing.get_context("forkserver")
        forkserver.set_forkserver_preload(
            [m for m in sys.modules if m.startswith(("touchgoal.", "benchmarks."))]
        )
        super().__init__(workers, mp_context=forkserver, initializer=_begin_work)
        self._ended = threading.Event()
        threading.Thread(target=self._notice_death, daemon=True).start()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See Executor."""
        try:
            super().shutdown(wait, cancel_futures=cancel_futures)
        finally:
            self._ended.set()

    def end_at_once(self) -> None:
        """Kill the workers and drop all work."""
        self._kill()
        self.shutdown(cancel_futures=True)

    def _notice_death(self) -> None:
        while not self._ended.wait(_LOOK):
            dead = wait([worker.sentinel for worker in self._workers()], timeout=0)
            if dead and not self._ended.wait(_LOOK) and not self._broken:
                self._kill()
                return

    def _kill(self) -> None:
        results = self._result_queue  # the pool lets go of it once its workers have ended
        for worker in self._workers():
            worker.kill()
            worker.join()
        if results is not None:
            with suppress(OSError):  # the pool's own thread may close it at the same time
                results._writer.close()  # pyright: ignore[reportAttributeAccessIssue]

    def _workers(self) -> list[BaseProcess]:
        """Return the workers; none before the first task and after the end."""
        return list((self._processes or {}).values())


@contextmanager
def one_core_workers(workers: int) -> Iterator[WorkerPool]:
    """Open a pool of processes that use one core each.

    If the block ends early, by Ctrl-C for example, or if this process is killed, the workers end at
    once and drop their current work.
    """
    pool = WorkerPool(workers)
    try:
        yield pool
    except BaseException:
        pool.end_at_once()
        raise
    pool.shutdown()


def use_one_core() -> None:
    """Start no threads in OpenCV or software OpenGL."""
    cv2.setNumThreads(1)
    os.environ["LP_NUM_THREADS"] = "1"


def _begin_work() -> None:
    """Ignore Ctrl-C, which the parent handles, and end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_one_core()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent is gone; the fork server and its tracker follow the last one."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)

"""Worker processes of one core each that end with the process that started them."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait

import cv2


@contextmanager
def one_core_workers(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Open a pool of processes that use one core each.

    OpenGL contexts do not survive a fork, so workers are forked from a server that never renders; it
    imports once what this process has imported. If the block ends early, by Ctrl-C for example, or if
    this process is killed, the workers end at once and drop their current work.
    """
    others = set(multiprocessing.active_children())
    forkserver = multiprocessing.get_context("forkserver")
    forkserver.set_forkserver_preload([m for m in sys.modules if m.startswith("touchgoal.")])
    pool = ProcessPoolExecutor(workers, mp_context=forkserver, initializer=_begin_work)
    try:
        yield pool
    except BaseException:
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        pool.shutdown(cancel_futures=True)
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

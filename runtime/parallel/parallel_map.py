"""Map of a function over items, on the cores of this machine or of a Ray cluster.

Worker processes have one core each, and end with the process that started them.
"""

import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from functools import partial
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeVar

import cv2

from touchgoal.runtime.errors import UserError, install_extra

Workers = int | str
"""Number of processes on this machine, or the address of a Ray cluster ("auto": the one started here)."""
Item = TypeVar("Item")
Result = TypeVar("Result")
Results = Generator[Result, None, None]

_AHEAD = 8  # items per core, in work or waiting to be read, so that a slow one leaves no core idle
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


def parallel_map(
    function: Callable[[Item], Result], items: Sequence[Item], workers: Workers
) -> "closing[Results[Result]]":
    """Compute the function of each item: `with parallel_map(…) as results:`, in the items' order.

    Each result comes once. If a worker dies or a node is lost, its items without a result are computed
    again, so the function must depend on its item alone. A few items per core are computed ahead of
    the reader. The workers end with the block. UserError: there is no such cluster, or the workers of
    an item die again and again.

    Args:
        function: must pickle; on Ray every node needs this version of touchgoal and the files it reads.
    """
    if isinstance(workers, str):
        return closing(_map_on_ray(function, items, workers))
    return closing(_map_on_processes(function, items, workers))


def _map_on_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Results[Result]:
    done = deaths = 0
    while done < len(items):
        try:
            with one_core_workers(min(workers, len(items) - done)) as pool:
                submit = partial(pool.submit, function)
                for result in _in_order(submit, Future.result, items[done:], lambda: workers):
                    done, deaths = done + 1, 0
                    yield result
        except BrokenProcessPool as error:
            if script := _unguarded_script():
                raise UserError(
                    f"workers run {script} anew and end in it: put what it does under "
                    'if __name__ == "__main__":'
                ) from error
            deaths += 1
            if deaths > RETRIES:
                raise UserError(
                    f"worker processes died {deaths} times: if memory is short, use fewer --workers"
                ) from error


def _unguarded_script() -> str:
    """Return the path of a running script without a main guard, which workers import; else ""."""
    main = sys.modules["__main__"]
    path = getattr(main, "__file__", None)
    if path is None or main.__spec__ is not None or not Path(path).is_file():
        return ""
    return "" if "__name__" in Path(path).read_text(errors="replace") else path


def _map_on_ray(
    function: Callable[[Item], Result], items: Sequence[Item], address: str
) -> Results[Result]:
    """Map on a cluster, whose number of cores changes as nodes come and go.

    Ray retries after deaths, and computes a result again if it is lost with its node.
    """
    with _connected(address) as ray:
        sent = ray.put(function)  # is sent once per node, not once per item
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(_call)

        def result(reference: Any) -> Result:
            try:
                return reference.future().result()  # `ray.get` takes SIGTERM for Ctrl-C
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except ray.exceptions.RayError as error:
                reason = str(error).strip().splitlines()[0]
                raise UserError(
                    f"the cluster lost an item {RETRIES + 1} times: {reason}"
                ) from error

        def cores() -> int:
            return int(ray.cluster_resources().get("CPU", 1))

        yield from _in_order(partial(task.remote, sent), result, items, cores)


def _in_order(
    submit: Callable[[Item], Any],
    wait: Callable[[Any], Result],
    items: Sequence[Item],
    cores: Callable[[], int],
) -> Results[Result]:
    """Submit items as results are read; yield the results in the order of the items."""
    submitted: deque[Any] = deque()
    for item in items:
        if len(submitted) >= _AHEAD * cores():
            yield wait(submitted.popleft())
        submitted.append(submit(item))
    while submitted:
        yield wait(submitted.popleft())


RETRIES = 3  # times that an item is computed again after its worker or its node died


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Connect to a cluster and yield the module ray; at the end unfinished work of this process is dropped.

    UserError: Ray is not installed, or no cluster answers.
    """
    try:
        import ray
    except ImportError:
        raise UserError(f"--ray needs Ray: {install_extra('ray')}") from None
    on_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"--ray {address}: {reason}; start a cluster by: ray start --head"
        ) from error
    signal.signal(signal.SIGTERM, on_sigterm)  # Ray's would end this process without a word
    try:
        yield ray
    finally:
        ray.shutdown()


def _call(function: Callable[[Any], Any], item: Any) -> Any:
    use_one_core()
    return function(item)

"""Map of a function over items, on the cores of this machine or of a Ray cluster."""

import sys
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.ray_cluster import RETRIES, ray_cluster
from touchgoal.runtime.parallel.worker_pool import one_core_workers

Workers = int | str
"""Number of processes on this machine, or the address of a Ray cluster ("auto": the one started here)."""
Item = TypeVar("Item")
Result = TypeVar("Result")
Results = Generator[Result, None, None]

_AHEAD = 8  # items per core, in work or waiting to be read, so that a slow one leaves no core idle


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
    with ray_cluster(address) as cluster:
        yield from _in_order(cluster.task(function), cluster.result, items, cluster.cores)


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

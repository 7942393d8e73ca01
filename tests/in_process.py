"""Commands, and workers that are no processes: what a pool would be given is done here, in order."""

import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest

from benchmarks.__main__ import main as benchmarks_main
from touchgoal.launch.__main__ import main
from touchgoal.runtime.parallel import parallel_map


class _InProcess(Executor):
    """Work and results are pickled, as on their way to a process."""

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:  # pyright: ignore
        future, work = Future(), pickle.dumps(partial(fn, *args, **kwargs))
        try:
            future.set_result(pickle.loads(pickle.dumps(pickle.loads(work)())))
        except Exception as error:
            future.set_exception(error)
        return future

    def end_at_once(self) -> None:
        """All work is done."""


@contextmanager
def in_process_workers() -> Iterator[None]:
    """A process takes seconds to start; where its isolation is not the subject, none does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parallel_map, "WorkerPool", lambda _: _InProcess())
        yield


def run(*arguments: object) -> None:
    main([str(a) for a in arguments])


def run_benchmark(*arguments: object) -> None:
    benchmarks_main([str(a) for a in arguments])

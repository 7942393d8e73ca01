"""Rates on one core, for the speed benchmarks."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
import torch


@dataclass(frozen=True)
class Row:
    """One measured rate, per second."""

    what: str
    median: float
    slowest: float
    fastest: float


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this process on one core (Linux), torch and OpenCV on one thread."""
    threads, cv_threads = torch.get_num_threads(), cv2.getNumThreads()
    cores = os.sched_getaffinity(0)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
        cv2.setNumThreads(cv_threads)
        torch.set_num_threads(threads)


def measure(
    what: str,
    repeats: int,
    count: int,
    work: Callable[[], object],
    clock: Callable[[], float] = time.perf_counter,
) -> Row:
    """Return how often something happens per second, if each `work` does it `count` times."""
    work()
    rates = []
    for _ in range(repeats):
        start = clock()
        work()
        rates.append(count / (clock() - start))
    return Row(what, float(np.median(rates)), min(rates), max(rates))


def in_turn(works: Sequence[Callable[[], object]], repeats: int) -> list[float]:
    """Return the median processor seconds of works that are timed in turn."""
    times: list[list[float]] = [[] for _ in works]
    for work in works:
        work()
    for _ in range(repeats):
        for work, spent in zip(works, times, strict=True):
            start = time.process_time()
            work()
            spent.append(time.process_time() - start)
    return [float(np.median(spent)) for spent in times]


def table(what: str, unit: str, rows: Sequence[Row]) -> str:
    """Return the rows as text."""
    lines = [f"{what:<72}{unit:>11}{'slowest':>10}{'fastest':>10}"]
    lines += [f"{r.what:<72}{r.median:>11,.0f}{r.slowest:>10,.0f}{r.fastest:>10,.0f}" for r in rows]
    return "\n".join(lines)

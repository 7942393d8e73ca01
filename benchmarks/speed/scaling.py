"""Collection and embedding on one and two cores, as processes and on Ray; what more cores would do."""

import os
import pickle
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.options import BenchmarkOptions
from touchgoal.control.features import TACTILE
from touchgoal.episodes.recording import episode_specs, expert_alone, record_encoded
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.policies.perception.frozen_touch import load_touch
from touchgoal.policies.training.embedding_cache import embed_episode
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError, install_extra
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import Workers, parallel_map
from touchgoal.sim_envs.config import PickPlaceConfig

CORES = (1, 2)
MODEL = (10, 100, 1_000, 10_000)  # cores


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark scaling."""

    repeats: Count = 3
    """Measurements of each rate, taken in turn; medians are printed."""
    episodes: Count = 8
    """Episodes in a measurement, more than two."""
    env: PickPlaceConfig = PickPlaceConfig()
    """Options of the task."""


@dataclass(frozen=True)
class Job:
    """Work on each of several items; this process receives the results by `take`."""

    name: str
    unit: str
    work: Callable[[Any], Any]
    items: Sequence[Any]
    counts: Sequence[float]  # units in each item
    take: Callable[[Any], object]


@dataclass(frozen=True)
class Measured:
    """One measurement of a job."""

    job: str
    unit: str
    ray: bool
    cores: int
    rate: float  # units a second, once every core has handed over a result
    first: float  # s to the first result
    ceiling: float  # units a second that this process alone can send out, receive and write
    size: float  # bytes of a unit as a worker hands it over


def run(config: Config) -> dict[str, Any]:
    """Measure each job in turn on every number of cores, then model more of them."""
    if config.episodes <= max(CORES):
        raise UserError(f"--episodes must be more than {max(CORES)}")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for i in range(config.repeats):
            for cores, ray in product(CORES, (False, True)):
                with _workers(cores, ray) as workers:
                    jobs = _jobs(config, Path(folder) / f"{i}-{cores}-{ray}")
                    rows += [_measure(job, workers, cores) for job in jobs]
    return {"rows": [asdict(row) for row in rows], "table": _table(rows)}


@contextmanager
def _workers(cores: int, ray: bool) -> Iterator[Workers]:
    """Yield processes, or a new Ray cluster on this machine, of so many cores."""
    if not ray:
        yield cores
        return
    try:
        from ray.cluster_utils import Cluster
    except ImportError:
        raise UserError(f"the half on Ray needs it: {install_extra('ray')}") from None
    # Ray sends no usage statistics, and its workers run at normal priority.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
    cluster = Cluster(True, head_node_args={"num_cpus": cores, "include_dashboard": False})
    try:
        yield str(cluster.address)
    finally:
        cluster.shutdown()


def _jobs(config: Config, root: Path) -> Iterator[Job]:
    """Yield the recording of a set, then its embedding."""
    specs = episode_specs(config.env, ("success",), config.episodes, seeds.TRAINING.start)
    record = partial(record_encoded, config.env, expert_alone)
    with closing(EpisodeWriter(root, fps=config.env.control_hz)) as writer:
        yield Job("collection", "episodes", record, specs, [1.0] * len(specs), writer.append)
    recorded, touch = EpisodeSet(root), load_touch("gelsight_mini")
    frames = [float(len(TACTILE) * length) for length in recorded.lengths]
    embed = partial(embed_episode, recorded, touch)
    yield Job("embedding", "frames", embed, range(len(recorded)), frames, np.asarray)


def _measure(job: Job, workers: Workers, cores: int) -> Measured:
    times, size, waited = [], 0, 0.0
    start, spent = time.perf_counter(), 0.0
    with parallel_map(job.work, job.items, workers) as results:
        for result in results:
            began, own = time.perf_counter(), time.process_time()
            job.take(result)
            now = time.perf_counter()
            waited += now - began - (time.process_time() - own)  # for the disk
            if not times:  # the start is over
                size, waited, spent = len(pickle.dumps(result)), 0.0, time.process_time()
            times.append(now - start)
        spent = time.process_time() - spent
    return Measured(
        job=job.name,
        unit=job.unit,
        ray=isinstance(workers, str),
        cores=cores,
        rate=sum(job.counts[cores:]) / (times[-1] - times[cores - 1]),
        first=times[0],
        ceiling=sum(job.counts[1:]) / (spent + waited),
        size=size / job.counts[0],
    )


def _table(rows: Sequence[Measured]) -> str:
    """Return the medians, and on Ray what more cores would do until this process is the limit."""
    lines = [f"{'':<33}{'1 core':>9}{'2 cores':>9}{'efficiency':>12}{'first result, s':>17}"]
    model = [f"{'on Ray, a second, of cores:':<33}" + "".join(f"{n:>10,}" for n in MODEL)]
    for job, ray in product(dict.fromkeys(row.job for row in rows), (False, True)):
        one, two = ([r for r in rows if (r.job, r.ray, r.cores) == (job, ray, n)] for n in CORES)
        unit, rate = one[0].unit, _median(r.rate for r in one)
        efficiency = _median(b.rate / a.rate / 2 for a, b in zip(one, two, strict=True))
        name = f"{job}, {'Ray' if ray else 'processes'}, {unit}/s"
        lines.append(
            f"{name:<33}{rate:>9.3g}{_median(r.rate for r in two):>9.3g}{efficiency:>12.2f}"
            f"{_median(r.first for r in two):>17.1f}"
        )
        if ray:
            # With one core of two at work this process has the other to itself.
            ceiling, size = _median(r.ceiling for r in one), _median(r.size for r in one)
            reached = "".join(f"{min(n * rate, ceiling):>10,.0f}" for n in MODEL)
            model.append(f"{f'{job}, {unit}':<33}{reached}")
            model.append(
                f"  the writing process: at most {ceiling:,.0f} {unit}/s, {ceiling / rate:,.0f} cores, "
                f"{ceiling * size / 1e6:.3g} MB/s"
            )
    return "\n".join([*lines, "", *model])


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))

"""Episodes a second against Ray workers up to what stops them, beside a model of it, on one machine.

Workers sleep in place of a simulation and return one recorded episode; touchgoal's own map hands them to its own
writer, as in `collect-demos --ray`. Rates count from when every worker has done two episodes, since Ray starts
workers anew for each map. Ceilings are measured alone, with few workers: what the head hands out (results of a byte),
what comes through the object store (whole episodes, not written), and what the writer takes. The model is the lower
of W / (s + d) and 1 / (r + w): s is the simulation, d what Ray adds to an item, from the runs with few workers, r
and w the seconds to receive and to write an episode. One number of workers is left out of it and predicted.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.options import BenchmarkOptions
from touchgoal.episodes.format.encoding import EncodedEpisode
from touchgoal.episodes.recording import EpisodeSpec, expert_alone, record_encoded
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.runtime.errors import UserError, install_extra
from touchgoal.runtime.option_types import Count, Positive, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.runtime.progress import track
from touchgoal.sim_envs.config import PickPlaceConfig

_FEW = 4  # workers up to which what Ray adds to an item is read
_FIRST = 2  # items of each worker that are not counted


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark scaling."""

    counts: tuple[Count, ...] = (1, 2, 4, 8, 16, 32, 64)
    """Numbers of workers to measure."""
    predicted: Count = 24
    """Number of workers that is predicted from the others, then measured."""
    seconds: Positive = 1.0
    """Sleep in place of the simulation of an episode, s."""
    rounds: Count = 6
    """Counted episodes of each worker in a measurement."""
    items: Count = 200
    """Counted items of a ceiling's measurement."""


def run(config: Config) -> dict[str, Any]:
    """Measure rates and ceilings; return them beside the model's."""
    task = PickPlaceConfig(cameras=())
    start = time.perf_counter()
    episode = record_encoded(task, expert_alone, EpisodeSpec(0, options=task.reset_options(1)[0]))
    simulated = time.perf_counter() - start
    with tempfile.TemporaryDirectory(prefix="scaling-") as name:
        write = partial(_write, Path(name))
        ceilings = {"writer": _rate([episode] * (config.items + 1), 1, write)}
        few = _FEW, config.items, _go_through
        ceilings["head"] = _measured(_byte, *few)
        ceilings["object store"] = _measured(partial(_work, 0.0, episode), *few)
        counts, rates = sorted({*config.counts, config.predicted}), {}
        for workers in track(counts, "measuring", "cluster", total=len(counts)):
            work = partial(_work, config.seconds, episode)
            rates[workers] = _measured(work, workers, config.rounds * workers, write)
    few_added = [w / rates[w] - config.seconds for w in config.counts if w <= _FEW]
    added = sum(few_added) / len(few_added)
    most = 1 / (1 / ceilings["object store"] + 1 / ceilings["writer"])
    model = {w: min(w / (config.seconds + added), most) for w in rates}
    measured = {"rates": rates, "model": model, "ceilings": ceilings, "added": added}
    table = _table(config, rates, model, ceilings) + [
        f"Ray adds {1e3 * added:.0f} ms to an episode; receiving and writing: {most:.0f} a second",
        f"one episode of {config.seconds:g} s took {simulated:.1f} s here to simulate and encode: its "
        f"writer keeps up with {most * (simulated + added):.0f} such cores",
    ]
    return {**measured, "predicted": config.predicted, "table": "\n".join(table)}


def _table(
    config: Config, rates: dict[int, float], model: dict[int, float], ceilings: dict[str, float]
) -> list[str]:
    lines = [f"{'workers':>8}{'measured a second':>20}{'model':>9}{'of measured':>13}"]
    for w, rate in rates.items():
        kind = "  left out of the model" if w == config.predicted else ""
        lines.append(f"{w:>8}{rate:>20.1f}{model[w]:>9.1f}{model[w] / rate:>13.2f}{kind}")
    return [*lines, *(f"{name} alone: {rate:.0f} a second" for name, rate in ceilings.items())]


def _measured(
    work: Callable[[int], Any], workers: int, count: int, read: Callable[[Iterable[Any]], None]
) -> float:
    """Return how many results a second are read of a cluster with so many workers."""
    first = _FIRST * workers
    with (
        _cluster(workers) as address,
        parallel_map(work, range(first + count), address) as results,
    ):
        return _rate(results, first, read)


def _rate(results: Iterable[Any], first: int, read: Callable[[Iterable[Any]], None]) -> float:
    """Return how many results a second are read after the first ones."""
    times: list[float] = []

    def noted() -> Iterator[Any]:
        for result in results:
            times.append(time.perf_counter())
            yield result

    read(noted())
    return (len(times) - first) / (time.perf_counter() - times[first - 1])


@contextmanager
def _cluster(workers: int) -> Iterator[str]:
    try:
        from ray.cluster_utils import Cluster
    except ImportError as error:
        raise UserError(f"scaling measures Ray: {install_extra('ray')}") from error
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # reports nothing to its makers
    cluster = Cluster(True, head_node_args={"num_cpus": workers, "include_dashboard": False})
    try:
        yield str(cluster.address)
    finally:
        cluster.shutdown()


def _work(seconds: float, episode: EncodedEpisode, _: int) -> EncodedEpisode:
    time.sleep(seconds)
    return episode


def _byte(_: int) -> bytes:
    return b"0"


def _go_through(results: Iterable[Any]) -> None:
    for _ in results:
        pass


def _write(folder: Path, episodes: Iterable[EncodedEpisode]) -> None:
    with (
        tempfile.TemporaryDirectory(dir=folder) as root,
        closing(EpisodeWriter(Path(root) / "set")) as writer,
    ):
        for episode in episodes:
            writer.append(episode)

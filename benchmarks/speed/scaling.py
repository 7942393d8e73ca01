"""Episodes a second against Ray workers up to what stops them, beside a model of it, on one machine.

Workers sleep in place of a simulation and return one recorded episode; `touchgoal`'s own map hands them to its own
writer, as in `collect-demos --ray`. Ceilings are measured alone: what the head dispatches (results of a byte), what
comes through the object store (whole episodes, not written), and what the one writer takes (episodes that are there).
The model is the lower of W / (s + d) and 1 / (r + w): s is the simulation, d what Ray adds to an item, from the runs
with few workers, r and w the seconds to receive and to write an episode. One number of workers is left out of it
and predicted.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.options import BenchmarkOptions
from touchgoal.episodes.format.encoding import EncodedEpisode
from touchgoal.episodes.recording import EpisodeSpec, expert_alone, record_encoded
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Positive, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import parallel_map
from touchgoal.sim_envs.config import PickPlaceConfig

_FEW = 4  # workers up to which what Ray adds to an item is read
_ITEMS = 200  # of a ceiling's measurement


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
    """Episodes of each worker in a measurement."""


def run(config: Config) -> dict[str, Any]:
    """Measure rates and ceilings; return them beside the model's."""
    task = PickPlaceConfig(cameras=())
    episode = record_encoded(task, expert_alone, EpisodeSpec(0, options=task.reset_options(1)[0]))
    with tempfile.TemporaryDirectory(prefix="scaling-") as name:
        write = partial(_write, Path(name) / "alone", [episode] * _ITEMS)
        ceilings = {"writer": _timed(write, _ITEMS)}
        with _cluster(_FEW) as address:
            for what, work in (("head", _byte), ("object store", partial(_work, 0.0, episode))):
                _drain(work, range(_FEW), address)  # starts the workers
                ceilings[what] = _timed(partial(_drain, work, range(_ITEMS), address), _ITEMS)
        rates = {}
        for workers in sorted({*config.counts, config.predicted}):
            with _cluster(workers) as address:
                work, count = partial(_work, config.seconds, episode), config.rounds * workers
                _drain(work, range(workers), address)
                record = partial(_record, Path(name) / str(workers), work, range(count), address)
                rates[workers] = _timed(record, count)
    return _told(config, rates, ceilings)


def _told(config: Config, rates: dict[int, float], ceilings: dict[str, float]) -> dict[str, Any]:
    few = [w / rates[w] - config.seconds for w in config.counts if w <= _FEW]
    added = sum(few) / len(few)
    most = 1 / (1 / ceilings["object store"] + 1 / ceilings["writer"])
    model = {w: min(w / (config.seconds + added), most) for w in rates}
    lines = [f"episodes of {config.seconds:g} s; each takes {1e3 * added:.0f} ms more through Ray"]
    lines += [f"{'workers':>8}{'measured a second':>20}{'model':>9}{'of measured':>13}"]
    for w, rate in rates.items():
        kind = "  left out of the model" if w == config.predicted else ""
        lines.append(f"{w:>8}{rate:>20.1f}{model[w]:>9.1f}{model[w] / rate:>13.2f}{kind}")
    lines += [f"{name} alone: {rate:.0f} a second" for name, rate in ceilings.items()]
    lines += [f"receiving and writing, one after the other: {most:.0f} a second"]
    off = abs(model[config.predicted] / rates[config.predicted] - 1)
    found = {"rates": rates, "ceilings": ceilings, "added": added, "off": off}
    return {"table": "\n".join(lines), **found}


@contextmanager
def _cluster(workers: int) -> Iterator[str]:
    try:
        from ray.cluster_utils import Cluster
    except ImportError as error:
        raise UserError("pip install 'touchgoal[ray]', which is measured here") from error
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


def _drain(work: Callable[[int], Any], items: Sequence[int], address: str) -> None:
    with parallel_map(work, items, address) as results:
        for _ in results:
            pass


def _record(root: Path, work: Callable[[int], Any], items: Sequence[int], address: str) -> None:
    with parallel_map(work, items, address) as episodes:
        _write(root, episodes)


def _write(root: Path, episodes: Any) -> None:
    with closing(EpisodeWriter(root)) as writer:
        for episode in episodes:
            writer.append(episode)


def _timed(work: Callable[[], object], count: int) -> float:
    """Return how many of `count` items are done a second."""
    start = time.perf_counter()
    work()
    return count / (time.perf_counter() - start)

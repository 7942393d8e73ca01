"""Seconds and memory to open, check and go through a set of a million episodes, and hundreds of sets as one.

The metadata of the large set are made up: rows of a few recorded episodes, again and again with other indices.
Data files of these few hold frames, the others are empty; all chunks but the first are links to it.
"""

import shutil
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Int

from benchmarks.options import BenchmarkOptions
from touchgoal.control import features as ft
from touchgoal.episodes.format import set_files
from touchgoal.episodes.format.joined import load_episodes
from touchgoal.episodes.format.metadata import SetMetadata
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.option_types import Count, checked_dataclass
from touchgoal.runtime.parallel.parallel_map import one_core_workers

_FRAMES = 3  # frames of an episode
_RECORDED, _IN_SHARD = 8, 2  # recorded episodes of the large set, and of a shard
_READ = 500  # episodes of the shards that are read


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark large-sets."""

    episodes: Count = 1_000_000
    """Episodes of the large set."""
    shards: Count = 500
    """Sets of two episodes that are opened as one."""


@dataclass(frozen=True)
class Step:
    """Cost of one step."""

    name: str
    seconds: float
    megabytes: float  # of memory at the peak of its process


def run(config: Config) -> dict[str, Any]:
    """Make the sets in a temporary folder and measure every step in a process of its own."""
    with TemporaryDirectory(prefix="large-sets-") as folder:
        large, shards = Path(folder) / "large", Path(folder) / "shards"
        _make_large(large, config.episodes)
        one = [
            _step("open, every file looked for", _open, large),
            _step("open and check the metadata alone", _open_metadata, large),
            _step("task and meta of every episode, shuffled", _go_through, large),
        ]
        _make_shards(shards, config.shards)
        many = [
            _step("open as one", _open, shards / "*"),
            _step("task and meta of every episode, shuffled", _go_through, shards / "*"),
            _step("merge the statistics", _merge, shards / "*"),
            _step(f"read {_READ} episodes, shuffled", _read, shards / "*"),
        ]
    heads = f"one set of {config.episodes:,} episodes", f"{config.shards:,} sets of {_IN_SHARD}"
    parts = zip(heads, (one, many), strict=True)
    return {
        "one": [asdict(step) for step in one],
        "many": [asdict(step) for step in many],
        "table": "\n".join(_table(head, steps) for head, steps in parts),
    }


def _table(head: str, steps: list[Step]) -> str:
    lines = [f"  {step.name:<46}{step.seconds:>9.2f}{step.megabytes:>9.0f}" for step in steps]
    return "\n".join([f"{head:<48}{'s':>9}{'peak MB':>9}", *lines])


def _step(name: str, work: Callable[[Path], Callable[[], object]], path: Path) -> Step:
    with one_core_workers(1) as pool:
        return Step(name, *pool.submit(_measured, work, path).result())


def _measured(work: Callable[[Path], Callable[[], object]], path: Path) -> tuple[float, float]:
    """Return the seconds of what `work` returns, and the peak memory of this process in MB."""
    timed = work(path)
    start = time.perf_counter()
    timed()
    seconds = time.perf_counter() - start
    status = Path("/proc/self/status").read_text().splitlines()
    peak = next(line for line in status if line.startswith("VmHWM"))
    return seconds, int(peak.split()[1]) / 1000


def _open(path: Path) -> Callable[[], object]:
    return partial(load_episodes, path)


def _open_metadata(path: Path) -> Callable[[], object]:
    return partial(EpisodeSet, path, complete=False)


def _go_through(path: Path) -> Callable[[], object]:
    episodes = load_episodes(path)
    order = np.random.default_rng(0).permutation(len(episodes)).tolist()

    def look() -> None:
        for i in order:
            _ = episodes.task(i), episodes.meta(i)

    return look


def _merge(path: Path) -> Callable[[], object]:
    episodes = load_episodes(path)
    return lambda: episodes.stats


def _read(path: Path) -> Callable[[], object]:
    episodes = load_episodes(path)
    order = np.random.default_rng(0).permutation(len(episodes))[:_READ].tolist()
    return lambda: [len(episodes.read(i)) for i in order]


def _episode(seed: int) -> Episode:
    """Return an episode with the features and meta of a demonstration of pick-place."""
    rng = np.random.default_rng(seed)
    frames: dict[str, np.ndarray] = {ft.TRUTH_CONTACT: rng.random((_FRAMES, 2)) < 0.5}
    for key in (ft.STATE, ft.TCP_POSE, ft.WRENCH, ft.COMMAND, ft.ACTION, ft.TRUTH_PAD_WRENCH):
        shape = _FRAMES, *ft.FEATURES[key].shape
        frames[key] = rng.standard_normal(shape).astype(np.float32)
    for key in (*ft.TACTILE, *ft.CAMERAS):
        frames[key] = rng.integers(0, 256, (_FRAMES, 24, 32, 3), np.uint8)
    meta = {
        "object": f"object_{seed % 100}",
        "descriptions": ["hard and smooth like glass", "slippery, cold and heavy", "round"],
        "sensor": "gelsight_mini",
        "task": "pick-place",
        "seed": seed,
        "outcome": "success",
        "success": True,
        "failures": ["dropped"],
        "mass": 0.1,
    }
    return Episode(frames, f"put object {seed % 100} into the bowl", meta)


def _record(root: Path, episodes: int) -> SetMetadata:
    with closing(EpisodeWriter(root)) as writer:
        for seed in range(episodes):
            writer.append(_episode(seed))
        assert writer.metadata is not None
        return writer.metadata


def _make_shards(root: Path, shards: int) -> None:
    """Write sets of the same few episodes."""
    _record(root / "0", _IN_SHARD)
    for number in range(1, shards):
        shutil.copytree(root / "0", root / str(number))


def _make_large(root: Path, episodes: int) -> None:
    """Write a set whose metadata name this many episodes."""
    made = _record(root, _RECORDED)
    tiled = made.files[0].take(np.arange(set_files.CHUNK) % _RECORDED)
    tables = [
        _rows(tiled, np.arange(first, min(first + set_files.CHUNK, episodes)))
        for first in range(0, episodes, set_files.CHUNK)
    ]
    SetMetadata(made.fps, made.features, made.tasks, made.stats, tuple(tables)).write(root)
    for first in [
        path for tree in ("data", "videos") for path in (root / tree).rglob("file-000.*")
    ]:
        for number in range(_RECORDED, set_files.CHUNK):
            first.with_stem(f"file-{number:03d}").touch()
        for chunk in range(1, len(tables)):
            first.parent.with_name(f"chunk-{chunk:03d}").symlink_to(first.parent.name)


def _rows(table: pa.Table, index: Int[np.ndarray, " n"]) -> pa.Table:
    """Return rows of meta/episodes for episodes `index`, with the facts of those in the table."""
    chunk, file = np.divmod(index, set_files.CHUNK)
    listed = {"chunk_index": chunk // set_files.CHUNK, "file_index": chunk % set_files.CHUNK}
    columns = {
        "episode_index": index,
        "dataset_from_index": index * _FRAMES,
        "dataset_to_index": (index + 1) * _FRAMES,
        set_files.META_PREFIX + "seed": index,
    }
    columns |= {f"meta/episodes/{name}": values for name, values in listed.items()}
    for name in table.column_names:
        if name.startswith(("data/", "videos/")) and name.endswith("_index"):
            columns[name] = chunk if name.endswith("chunk_index") else file
    table = table.slice(0, len(index))
    for name, values in columns.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    return table

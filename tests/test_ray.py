"""Work on a Ray cluster of two nodes, one of which is lost, and on processes that are killed."""

import json
import math
import multiprocessing
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from in_process import in_process_workers, run_benchmark

from benchmarks.speed import scaling
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.rewards.report.frame_table import FRAMES
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.parallel.parallel_map import one_core_workers, parallel_map

NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}
DEMOS = "collect-demos --episodes 4 --env.objects glass_ball --env.control-hz 10 --env.no-tactile"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    Cluster = pytest.importorskip("ray.cluster_utils").Cluster
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")  # reports nothing to its makers
        patch.setenv("RAY_worker_niceness", "0")  # by default workers give way to everything else
        cluster = Cluster(True, head_node_args={**NODE, "include_dashboard": False})
        yield cluster
        cluster.shutdown()


def test_a_node_may_be_lost(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    local, on_ray, append = tmp_path / "local", tmp_path / "ray", EpisodeWriter.append
    with in_process_workers():
        main([*DEMOS.split(), "--out", str(local)])
    nodes = [cluster.add_node(**NODE)]

    def append_and_lose_a_node(writer: EpisodeWriter, episode: Any) -> None:
        append(writer, episode)
        if nodes:
            cluster.remove_node(nodes.pop(), allow_graceful=False)

    monkeypatch.setattr(EpisodeWriter, "append", append_and_lose_a_node)
    main([*DEMOS.split(), "--ray", cluster.address, "--out", str(on_ray)])
    assert not nodes
    files = sorted(p for p in (local / "episodes").rglob("*") if p.is_file())
    for file in files:
        assert file.read_bytes() == (on_ray / file.relative_to(local)).read_bytes(), file
    assert EpisodeSet(on_ray / "episodes").checksum == EpisodeSet(local / "episodes").checksum
    curves = ["reward-curves", str(local / "episodes"), "--plots", "0", "--out"]
    main([*curves, str(tmp_path / "here")])
    main([*curves, str(tmp_path / "there"), "--ray", cluster.address])
    here, there = (pq.read_table(tmp_path / out / FRAMES) for out in ("here", "there"))
    assert here.num_rows and here.equals(there)


def test_scaling_counts_from_when_the_workers_have_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On local processes, which stand in for a cluster's; rates by a clock of its own."""
    with monkeypatch.context() as patch, in_process_workers():
        patch.setattr(scaling, "_cluster", nullcontext)
        sizes = "--counts 1 --predicted 2 --seconds 0.01 --rounds 1 --items 2 --out"
        run_benchmark("scaling", *sizes.split(), tmp_path)
    told = json.loads((tmp_path / "metrics.json").read_text())
    most = 1 / sum(1 / told["ceilings"][what] for what in ("writer", "object store"))
    assert told["model"]["2"] == pytest.approx(min(2 / (0.01 + told["added"]), most))
    clock = iter([10, 10, 11, 11, 12, 12, 12])  # two workers begin within 10 s, then 1 s an item
    monkeypatch.setattr(scaling.time, "perf_counter", lambda: next(clock))
    assert scaling._rate(range(6), 2, scaling._go_through) == 2


def test_errors_are_the_same(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with parallel_map(find_sensor, ["gelsight_mini", "none"], cluster.address) as sensors:
        assert next(sensors) == find_sensor("gelsight_mini")
        with pytest.raises(UserError, match="^unknown sensor .* 'none'"):
            next(sensors)
    refused = ["collect-demos", "--out", str(tmp_path), "--ray"]
    with pytest.raises(SystemExit, match="--ray nowhere: .*start a cluster by"):
        main([*refused, "nowhere"])
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit, match="--ray needs Ray: pip install"):
        main([*refused, cluster.address])


@pytest.mark.parametrize(
    "function", [math.sqrt, partial(np.full, 5_000_000)], ids=["computing", "sending its result"]
)
def test_a_killed_process_loses_nothing(function: Callable[[int], Any]) -> None:
    with parallel_map(function, range(12), 2) as results:
        first = next(results)
        multiprocessing.active_children()[0].kill()
        found = [first, *results]
    assert all(np.array_equal(f, function(i)) for i, f in enumerate(found)) and len(found) == 12


@pytest.mark.parametrize("which", [0, 1])  # one of them keeps the queue of work locked
def test_a_process_killed_while_it_waits_for_work_keeps_nobody_waiting(which: int) -> None:
    with one_core_workers(2) as pool:
        assert [*pool.map(abs, range(12))] == [*range(12)]
        multiprocessing.active_children()[which].kill()
    assert not multiprocessing.active_children()


def test_an_error_while_large_results_come_ends_the_workers() -> None:
    with (
        pytest.raises(UserError, match="disk"),
        parallel_map(np.ones, [20_000_000] * 20, 2) as results,
    ):
        next(results)
        raise UserError("the disk is full")
    assert not multiprocessing.active_children()


def test_a_script_without_a_main_guard_is_told_of_it(tmp_path: Path) -> None:
    script, work = (
        tmp_path / "script.py",
        "with parallel_map(abs, [1], 1) as found:\n    list(found)\n",
    )
    script.write_text(
        f"from touchgoal.runtime.parallel.parallel_map import parallel_map\n{work}", "utf-8"
    )
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60)
    assert f"workers run {script} anew" in run.stderr and "memory" not in run.stderr


def test_no_json_file_holds_what_is_no_json(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json", {"a": [np.float32("nan"), (np.inf, 1.5)], "b": tmp_path, "c": None}
    )
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text) == {"a": [None, [None, 1.5]], "b": str(tmp_path), "c": None}
    assert "Infinity" not in text and "NaN" not in text

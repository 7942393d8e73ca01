"""Shards of a recording are its episodes; many sets are read as one."""

from pathlib import Path

import numpy as np
import pytest
from in_process import in_process_workers, run_benchmark
from test_collect_demos import QUICK
from toy_episodes import FPS, make_episode, record

from touchgoal.control import features as ft
from touchgoal.episodes.embedding_files import embedding_file
from touchgoal.episodes.format.joined import load_episodes
from touchgoal.episodes.outcomes.judged import JUDGED, JudgedOutcome, read_judged, write_judged
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.slide_recording import Recorded, record_rig
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.shard import Shard, parse_shard


def contents(path: Path) -> set[str]:
    episodes = load_episodes(path)
    found = {episodes.episode_checksum(i) for i in range(len(episodes))}
    assert len(found) == len(episodes)
    return found


def test_shards_of_demonstrations_are_those_of_one_run(
    in_process: None, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    command = ["collect-demos", "--episodes", "2", "--outcomes", "success", "never_touch", *QUICK]
    main([*command, "--out", str(tmp_path / "whole")])
    for i in (1, 0):
        main([*command, "--shard", f"{i}/2", "--out", str(tmp_path / f"shards/{i}")])
    assert contents(tmp_path / "shards/*") == contents(tmp_path / "whole/episodes")
    seeds = [load_episodes(tmp_path / "shards/*").meta(i)["seed"] for i in range(4)]
    assert seeds == [0, 1, 2, 3]
    main([*command, "--shard", "1/2", "--out", str(tmp_path / "shards/1")])
    assert "nothing left to record: 2 episodes; more: --seed 4" in capsys.readouterr().out


def slide(index: int) -> Recorded:
    episode = make_episode(index)
    return episode.frames, episode.task, episode.meta


def test_a_shard_of_slides_goes_on_where_it_was(tmp_path: Path) -> None:
    with in_process_workers():
        record_rig(tmp_path / "whole", slide, "toy", 5, 1)
        for i, counts in enumerate([(1, 5), (2, 5)]):
            for count in counts:
                record_rig(tmp_path / "shards" / str(i), slide, "toy", count, 1, Shard(i, 2))
        assert contents(tmp_path / "shards/*") == contents(tmp_path / "whole")
        with pytest.raises(UserError, match="another shard's episodes"):
            record_rig(tmp_path / "shards/0", slide, "toy", 5, 1, Shard(1, 2))


@pytest.mark.parametrize(
    ("text", "message"), [("4/4", "0/4, 1/4, 2/4 and 3/4"), ("2", "I/N"), ("0/9", "at most I/8")]
)
def test_no_such_shard(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        parse_shard(text, 8)


def test_many_sets_are_read_as_one(tmp_path: Path) -> None:
    record(tmp_path / "one", range(6))
    for name, first in (("2", 0), ("10", 2), ("11", 4)):  # by number, not by letter
        record(tmp_path / f"runs/{name}/episodes", range(first, first + 2))
    (tmp_path / "runs/notes.txt").touch()
    one, many = EpisodeSet(tmp_path / "one"), load_episodes(tmp_path / "runs/*")
    assert many.lengths == one.lengths and many.features == one.features
    for i in range(6):
        assert many.episode_checksum(i) == one.episode_checksum(i)
        assert (many.task(i), many.meta(i)) == (one.task(i), one.meta(i))
        for key, values in one.read(i, frames=[5, 0]).frames.items():
            np.testing.assert_array_equal(many.read(i, [key], [5, 0]).frames[key], values)
    for name, values in one.stats[ft.ACTION].items():
        if not name.startswith("q"):  # LeRobot's quantiles depend on the order of merging
            np.testing.assert_allclose(many.stats[ft.ACTION][name], values)
    write_judged(many, {3: JudgedOutcome("success")})
    assert read_judged(many) == {3: JudgedOutcome("success")}
    shard = tmp_path / "runs/10/episodes"
    assert (shard / JUDGED).is_file() and embedding_file(many, 3, "x", ".npy").is_relative_to(shard)
    with pytest.raises(UserError, match="has episodes 0 to 5, not 6"):
        many.read(6)


def test_sets_that_cannot_be_one(tmp_path: Path) -> None:
    record(tmp_path / "runs/0", range(1))
    with pytest.raises(UserError, match="matches no folder"):
        load_episodes(tmp_path / "run/*")
    (tmp_path / "runs/1").mkdir()
    with pytest.raises(UserError, match=r"runs/1 is not a set of episodes"):
        load_episodes(tmp_path / "runs/*")
    frames = {key: make_episode(0).frames[key] for key in (ft.STATE, ft.ACTION)}
    EpisodeWriter(tmp_path / "others/0", FPS).append(Episode(frames, "lift"))
    with pytest.raises(UserError, match="differ in observation.images.tactile_left"):
        load_episodes(tmp_path / "*/0")


def test_the_benchmark_of_large_sets(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with in_process_workers():
        run_benchmark("large-sets", "--episodes", 1005, "--shards", 2, "--out", tmp_path / "out")
    printed = capsys.readouterr().out
    assert "one set of 1,005 episodes" in printed and "merge the statistics" in printed

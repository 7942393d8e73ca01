"""Sets on a remote file system: read lazily through a mirror, from an S3 server on this machine."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from lerobot_layout import write_lerobot_set
from s3_server import S3Server
from test_lerobot_sets import arm_frames
from toy_episodes import make_episode

import touchgoal
from touchgoal.episodes.format import remote
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError

ADDRESS = "s3://bucket/run"


@pytest.fixture
def s3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """A bucket with a run of three episodes, and an empty cache."""
    writer = EpisodeWriter(tmp_path / "s3/bucket/run/episodes")
    for i in range(3):
        writer.append(make_episode(seed=i))
    writer.close()
    with S3Server(tmp_path / "s3").running() as server:
        for name, value in {
            "AWS_ENDPOINT_URL": server.url,
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1",
            "XDG_CACHE_HOME": str(tmp_path / "cache"),
        }.items():
            monkeypatch.setenv(name, value)
        remote._open.cache_clear()
        yield server


def data_files(server: S3Server) -> list[str]:
    return [name for name in server.read if "/meta/" not in name]


def test_a_file_is_fetched_when_first_read(s3: S3Server) -> None:
    episodes = touchgoal.load_episodes(ADDRESS)
    assert data_files(s3) == ["run/episodes/data/chunk-000/file-002.parquet"], "whose set is it"
    local = EpisodeSet(s3.root / "bucket/run/episodes")
    for _ in range(2):
        for key, values in episodes.read(1).frames.items():
            np.testing.assert_array_equal(values, local.read(1).frames[key])
    files = data_files(s3)
    assert len(files) == len({*files}) and not [name for name in files if "file-000" in name]
    assert episodes.checksum == local.checksum
    before = len(s3.read)
    EpisodeSet(episodes.root).read(1)  # the mirror is a set like any other
    assert len(s3.read) == before


def test_what_changed_there_is_fetched_again(s3: S3Server) -> None:
    EpisodeSet(ADDRESS).read(0)
    there = s3.root / "bucket/run/episodes"
    with pytest.raises(UserError, match="is only read: record into a local folder"):
        EpisodeWriter(ADDRESS)
    EpisodeWriter(there).append(make_episode(seed=7))
    later = time.time() + 60
    for path in (there / "meta").rglob("*.*"):
        os.utime(path, (later, later))
    grown = EpisodeSet(ADDRESS)
    assert len(grown) == 4 and grown.read(3).task
    (there / "data/chunk-000/file-001.parquet").unlink()
    with pytest.raises(UserError, match="file-001.parquet is missing"):
        EpisodeSet(ADDRESS)
    with pytest.raises(UserError, match=r"s3://.*file-001.parquet does not exist"):
        EpisodeSet(ADDRESS, complete=False).read(1)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("s3://other/run", "cannot read s3://other/run .*bucket does not exist"),
        ("s3://bucket/nothing", "s3://bucket/nothing does not exist: check the address"),
        ("ftps://host/set", "cannot read ftps://host/set .Unrecognized filesystem"),
    ],
)
def test_errors_are_one_line(s3: S3Server, address: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        EpisodeSet(address)
    assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_commands_read_lerobot_sets_there(
    s3: S3Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_lerobot_set(s3.root / "bucket" / "set", [arm_frames(i) for i in range(2)])
    main(["reward-curves", "s3://bucket/set", "--out", str(tmp_path / "curves")])
    assert "2 measured" in capsys.readouterr().out

"""Sets in lerobot's layout, and sets on a remote file system, are read; faults are named."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from lerobot_layout import Frames, toy_frames, write_lerobot_set
from s3_server import S3Server
from toy_episodes import make_episode

import touchgoal
from touchgoal.control import features as ft
from touchgoal.episodes.faults import find_faults, leave_out_faulty
from touchgoal.episodes.format import remote, set_files
from touchgoal.episodes.keys import parse_keys
from touchgoal.episodes.media import write_video
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.launch.__main__ import main
from touchgoal.rewards.goals import EpisodeEnds, parse_goal
from touchgoal.runtime.errors import UserError

TOP = "observation.images.top"


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    write_lerobot_set(tmp_path / "foreign", [toy_frames(i, 24 + i) for i in range(3)])
    return tmp_path / "foreign"


def test_rows_and_frames_of_each_episode(foreign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episodes = touchgoal.load_episodes(foreign, {TOP: ft.FRONT})
    assert "gelsight_left=observation.images.tactile_left" in capsys.readouterr().err
    assert (len(episodes), episodes.fps, episodes.lengths) == (3, 15, [24, 25, 26])
    assert set(episodes.features) == {ft.FRONT, *ft.TACTILE, ft.STATE, ft.ACTION}, "no texts"
    for i in (2, 0, 1):
        written, frames = toy_frames(i, 24 + i), [23, 4, 11, 5]
        read = episodes.read(i, frames=frames).frames
        np.testing.assert_array_equal(read[ft.STATE], written["observation.state"][frames])
        assert read[ft.ACTION].dtype == np.float32
        off = read[ft.FRONT].astype(int) - written[TOP][frames]
        assert np.abs(off).mean() < 4 and abs(off[..., 0].mean()) < 2, "a frame's step is 4"
    with pytest.raises(UserError, match="lerobot wrote .* changes nothing here"):
        EpisodeWriter(foreign, 15)


def test_checksums_are_of_the_content(foreign: Path, tmp_path: Path) -> None:
    """Episodes of equal length and numbers whose images alone differ are not the same."""
    other = [toy_frames(i, 24 + i) for i in range(3)]
    other[1]["observation.images.gelsight_left"] = other[1][TOP]
    write_lerobot_set(tmp_path / "other", other)
    shutil.copytree(foreign, tmp_path / "copy")
    here, changed = EpisodeSet(foreign), EpisodeSet(tmp_path / "other")
    copied = EpisodeSet(tmp_path / "copy")
    assert here.checksum == copied.checksum != changed.checksum
    assert here.episode_checksum(1) != changed.episode_checksum(1)
    assert len({here.episode_checksum(i) for i in range(3)}) == 3


def _stamps(change: Callable[[np.ndarray], object]) -> Callable[[Frames], None]:
    def spoil(frames: Frames) -> None:
        frames["timestamp"] = (np.arange(len(frames["action"])) / 15).astype(np.float32)
        change(frames["timestamp"])

    return spoil


def _set(key: str, frame: int, value: float) -> Callable[[Frames], None]:
    return lambda frames: frames[key].__setitem__((frame, 2), value)


FAULTS = {
    "frame 9 has the time stamp 1.6": _stamps(lambda t: t.__setitem__(slice(9, None), t[9:] + 1)),
    "frame 6 has the time stamp 0.333 s after 0.333": _stamps(lambda t: t.__setitem__(6, t[5])),
    "observation.state is not finite at frame 7": _set("observation.state", 7, np.nan),
    "": _stamps(lambda t: np.add(t, np.random.default_rng(0).uniform(-0.02, 0.02, len(t)), t)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path: Path, fault: str, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = [toy_frames(i) for i in range(3)]
    for frames in recorded:
        _stamps(lambda t: None)(frames)
    FAULTS[fault](recorded[1])
    write_lerobot_set(tmp_path, recorded)
    episodes = EpisodeSet(tmp_path)
    left = leave_out_faulty(episodes, range(3), [ft.STATE])
    assert left == ([0, 2] if fault else [0, 1, 2]), "jitter below half a frame is none"
    assert not fault or f"episode 1 of {tmp_path}: {fault}" in capsys.readouterr().err
    assert 1 not in find_faults(episodes, [1], [ft.ACTION]) or "state" not in fault


def test_a_video_that_is_too_short_or_of_another_rate(foreign: Path) -> None:
    path = foreign / set_files.video_path(TOP, 0)
    write_video(path, toy_frames(0, 60)[TOP], 15)
    episodes = EpisodeSet(foreign)
    assert find_faults(episodes, [1, 2], [TOP]) == {
        2: f"episode 2 of {foreign}: {TOP} ends at frame 11, the table at frame 26"
    }
    with pytest.raises(UserError, match="the video has no frame 60"):
        episodes.read(2, [TOP])
    write_video(path, toy_frames(0, 75)[TOP], 30)
    assert "30 frames per second" in find_faults(EpisodeSet(foreign), [0], [TOP])[0]


def test_surplus_frames_at_the_end_of_a_video_are_told_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = [toy_frames(i, 24) for i in range(3)]
    for key in ("observation.state", "action"):
        recorded[1][key] = recorded[1][key][:16]
    write_lerobot_set(tmp_path, recorded)
    episodes = EpisodeSet(tmp_path)
    assert leave_out_faulty(episodes, range(3), [TOP]) == [0, 1, 2] and episodes.lengths[1] == 16
    assert f"episode 1 of {tmp_path}: {TOP} has 8 frames more" in capsys.readouterr().err
    for i, n in enumerate(episodes.lengths):  # those after it are read from their own start
        off = episodes.read(i, [TOP]).frames[TOP].astype(int) - recorded[i][TOP][:n]
        assert np.abs(off).mean() < 4


def test_keys_rename_features_of_a_set_and_of_goals(foreign: Path) -> None:
    keys = parse_keys([f"{TOP}={ft.FRONT}"])
    assert {TOP, ft.FRONT} & EpisodeSet(foreign, keys=keys).features.keys() == {ft.FRONT}
    goal = parse_goal(f"episode:{foreign}#0", keys)
    assert isinstance(goal, EpisodeEnds)
    assert next(goal.read([ft.FRONT]))[1].frames[ft.FRONT].ndim == 4
    assert ft.FRONT not in EpisodeSet(foreign).features, "another set is not affected"


HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], np.float32)


def arm_frames(seed: int, n: int = 40) -> Frames:
    """An FR3 near its home, as lerobot would record it with touchgoal's keys, seen by a camera `top`."""
    rng = np.random.default_rng(seed)
    joints = HOME + 0.01 * np.cumsum(rng.normal(size=(n, 7)), 0)
    state = np.concatenate([joints, np.zeros((n, 7)), np.full((n, 1), 0.04)], 1)
    pose = np.concatenate([rng.normal(size=(n, 3)), np.tile([1.0, 0, 0, 0], (n, 1))], 1)
    numbers = {
        ft.STATE: state,
        ft.TCP_POSE: pose,
        ft.ACTION: np.concatenate([np.diff(joints, axis=0, append=joints[-1:]), state[:, -1:]], 1),
        "timestamp": np.arange(n) / 15 + rng.uniform(-0.01, 0.01, n),
    }
    numbers = {key: values.astype(np.float32) for key, values in numbers.items()}
    return {TOP: toy_frames(seed, n)[TOP], **numbers}


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_commands_leave_faults_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train = [arm_frames(i) for i in range(3)]
    train[1]["timestamp"][20:] += 0.5
    write_lerobot_set(tmp_path / "train", train)
    write_lerobot_set(tmp_path / "validation", [arm_frames(9), arm_frames(10)])
    main(["reward-curves", str(tmp_path / "train"), "--out", str(tmp_path / "curves")])
    assert "1 of 3 skipped" in (printed := capsys.readouterr().out) and "one camera" in printed
    assert "frame 20 has the time stamp" in (tmp_path / "curves/skipped.csv").read_text()
    options = "--include-unknown --task pick-place --trials 0 --train.epochs 1".split()
    data = ["--data", str(tmp_path / "train"), "--validation", str(tmp_path / "validation")]
    main(["train-policy", *data, *options, "--out", str(tmp_path / "policy")])
    printed = capsys.readouterr()
    assert "2 episodes for training, 2 episodes for validation" in printed.out
    assert "episode 1 of" in printed.err and "frame 20 has the time stamp" in printed.err


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


def test_many_sets_there_are_read_as_one(s3: S3Server) -> None:
    shutil.copytree(s3.root / "bucket/run", s3.root / "bucket/runs/0")
    shutil.copytree(s3.root / "bucket/run/episodes", s3.root / "bucket/runs/1")
    many = touchgoal.load_episodes("s3://bucket/runs/*")
    assert [many.meta(i)["seed"] for i in range(len(many))] == [0, 1, 2] * 2
    np.testing.assert_array_equal(many.read(4).frames[ft.STATE], many.read(1).frames[ft.STATE])


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

"""Sets that were damaged, or whose recorder was killed: nothing sound is lost."""

import os
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from toy_episodes import FPS, PNG_START, assert_holds, flip_byte, make_episode, record

from touchgoal.control import features as ft
from touchgoal.episodes.format import metadata, set_files
from touchgoal.episodes.format.repair import repair, validate
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.rewards.sources.open_source import open_source
from touchgoal.runtime.errors import UserError


@pytest.mark.parametrize(
    ("name", "begin", "told"),
    [
        ("demo.hdf5", b"", "HDF5, as robomimic"),
        ("log.mcap", b"", "an MCAP log"),
        ("run.bag", b"", "a ROS bag"),
        ("run_0.db3", b"", "a ROS 2 bag"),
        ("a.npz", b"", "a NumPy archive"),
        ("a.npy", b"", "a NumPy array"),
        ("a.pkl", b"", "a Python pickle"),
        ("renamed.mp4", b"\x89HDF\r\n\x1a\n", "HDF5, as robomimic"),
    ],
)
def test_another_format_is_known_by_name(
    name: str, begin: bytes, told: str, tmp_path: Path
) -> None:
    numpy = "NumPy" in told or "pickle" in told
    way = "convert it to a LeRobotDataset v3" if numpy else "by touchgoal import-demos"
    path = tmp_path / name
    path.write_bytes(begin + bytes(100))
    folder = [] if path.suffix == ".mp4" else [partial(open_source, tmp_path, "front")]
    for reader in (partial(open_source, path, "front"), partial(EpisodeSet, path), *folder):
        with pytest.raises(UserError, match=f"{name} is {told}.*{way}"):
            reader()


def cut_in_half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DATA, VIDEO = set_files.data_path(1), set_files.video_path(ft.WRIST, 1)
DAMAGE = {
    "flipped byte in touch": (
        DATA,
        lambda path: flip_byte(path, path.read_bytes().index(PNG_START) + 100),
    ),
    "half a data file": (DATA, cut_in_half),
    "flipped byte in a video": (VIDEO, lambda path: flip_byte(path, 400)),
    "half a video": (VIDEO, cut_in_half),
    "no data file": (DATA, Path.unlink),
    "no video": (VIDEO, Path.unlink),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_episode_is_named_and_moved_aside(small: Path, case: str) -> None:
    name, harm = DAMAGE[case]
    harm(small / name)
    with pytest.raises(UserError, match=name) as error:
        EpisodeSet(small).read(1)
    assert "\n" not in str(error.value) and "touchgoal repair" in str(error.value)
    assert any(name in problem for problem in validate(small))
    assert repair(small)
    assert validate(small) == []
    assert_holds(small, [0, 2])
    assert EpisodeWriter(small, FPS).append(make_episode(4)) == 2
    assert_holds(small, [0, 2, 4])
    assert validate(small) == [] and repair(small) == []


METADATA = set_files.INFO, set_files.EPISODES, set_files.TASKS, set_files.STATS


@pytest.mark.parametrize("name", METADATA)
@pytest.mark.parametrize("harm", [cut_in_half, Path.unlink])
def test_damaged_metadata_is_made_again(small: Path, name: str, harm) -> None:
    before = metadata.SetMetadata.load(small)
    harm(small / name)
    assert any(name in problem for problem in validate(small))
    assert repair(small)
    assert validate(small) == []
    after = metadata.SetMetadata.load(small)
    assert (after.info(), after.stats) == (before.info(), before.stats)
    assert_holds(small, [0, 1, 2])


@pytest.mark.parametrize("name", [*METADATA, DATA, VIDEO])
def test_a_flipped_byte_is_noticed_or_without_effect(small: Path, name: str) -> None:
    whole, rng = (small / name).read_bytes(), np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 25):
        data = bytearray(whole)
        data[place] ^= 1 << int(rng.integers(8))
        (small / name).write_bytes(bytes(data))
        try:
            if not validate(small):
                assert_holds(small, [0, 1, 2])
        except UserError:
            pass


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"fps": 20', '"fps": 0', "wrong fps = 0"),
        ('"fps": 20', '"fps": 20, "fps": 30', "the key 'fps' is given twice"),
        ('"features": {', '"features": 3, "f": {', "wrong features"),
        (ft.WRIST, ft.WRIST.replace("wrist", "wrast"), "unknown feature .*wrast"),
    ],
)
def test_impossible_values_are_named(small: Path, old: str, new: str, message: str) -> None:
    text = (small / set_files.INFO).read_text()
    assert old in text
    (small / set_files.INFO).write_text(text.replace(old, new, 1))
    for use in (EpisodeSet, EpisodeWriter):
        with pytest.raises(UserError, match=f"info.json is corrupt .*{message}.* repair --fix"):
            use(small)
    assert validate(small) and repair(small) and validate(small) == []
    assert_holds(small, [0, 1, 2])


class Killed(BaseException):
    """Stands for the process ending here."""


def test_killed_at_every_write(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ends an append at each of its writes, with the file half written and fully written."""
    replace, steps = os.replace, 0
    for step in range(100):
        root = shutil.copytree(small, small.with_name(f"killed_{step}"))
        writer, calls = EpisodeWriter(root, FPS), 0

        def die(source: Path, target: Path, step: int = step) -> None:
            nonlocal calls
            if calls == step // 2:
                if step % 2:
                    cut_in_half(Path(source))
                raise Killed
            calls += 1
            replace(source, target)

        monkeypatch.setattr(os, "replace", die)
        try:
            writer.append(make_episode(3))
            break
        except Killed:
            steps += 1
        finally:
            monkeypatch.setattr(os, "replace", replace)
        writer.close()
        assert_holds(root, [0, 1, 2])
        with pytest.raises(UserError, match="interrupted.*repair"):
            EpisodeWriter(root, FPS)
        assert repair(root)
        left = len(EpisodeSet(root))
        EpisodeWriter(root, FPS).append(make_episode(left))
        assert_holds(root, list(range(left + 1)))
        assert validate(root) == []
    assert steps == 2 * 6, "a video, a data file and four files of metadata"


def test_killed_in_the_first_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def die(source: Path, target: Path) -> None:
        raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", die)
        record(tmp_path, range(1))
    with pytest.raises(UserError, match="interrupted"):
        EpisodeSet(tmp_path)
    assert "no whole episode" in repair(tmp_path)[-1]
    record(tmp_path, range(2))
    assert validate(tmp_path) == []

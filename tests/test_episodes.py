"""Sets of episodes: what is read is what was written; what does not fit is refused."""

import io
import json
import pickle
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from toy_episodes import FPS, assert_holds, make_episode, moving_blob, record

from touchgoal.control import features as ft
from touchgoal.control.sensors.clip import read_frames
from touchgoal.episodes.format import encoding, set_files
from touchgoal.episodes.format.encoding import encode
from touchgoal.episodes.format.repair import repair, validate
from touchgoal.episodes.media import write_video
from touchgoal.episodes.overlap import require_disjoint
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.errors import UserError


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("set") / "episodes"
    record(root, range(3), n=70)
    return root


def test_round_trip(recorded: Path) -> None:
    assert validate(recorded) == []
    assert_holds(recorded, [0, 1, 2], n=70)


def test_a_long_episode_is_written_in_few_groups_and_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encoding, "_MAX_ROW_GROUPS", 2)
    episode, usual = make_episode(0, 100), pa.default_memory_pool()
    pool = pa.proxy_memory_pool(usual)
    noise = np.random.default_rng(0).integers(0, 256, (100, 160, 240, 3), np.uint8)
    episode.frames[ft.TACTILE_LEFT] = noise  # 12 MB
    pa.set_memory_pool(pool)
    try:
        EpisodeWriter(tmp_path, FPS).append(episode)
    finally:
        pa.set_memory_pool(usual)
    file = pq.ParquetFile(tmp_path / set_files.data_path(0))
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [50, 50]
    assert 0 < (pool.max_memory() or 0) < 4e6
    read = EpisodeSet(tmp_path).read(0, frames=range(40, 60)).frames
    for key, values in episode.frames.items():
        np.testing.assert_array_equal(read[key], values[40:60], err_msg=key)


def test_files_are_what_lerobot_reads(recorded: Path) -> None:
    info = json.loads((recorded / set_files.INFO).read_text())
    assert info["codebase_version"] == "v3.0" and info["total_frames"] == 210
    dtypes = {key: feature["dtype"] for key, feature in info["features"].items()}
    assert (dtypes[ft.WRIST], dtypes[ft.TACTILE_LEFT]) == ("video", "image")
    assert (dtypes[ft.TRUTH_CONTACT], dtypes[ft.STATE]) == ("bool", "float32")
    pandas = pq.read_table(recorded / set_files.TASKS).schema.pandas_metadata
    assert pandas["index_columns"] == ["task"]
    rows = pq.read_table(recorded / set_files.EPISODES).to_pylist()
    assert [row["dataset_from_index"] for row in rows] == [0, 70, 140]
    assert rows[2][f"videos/{ft.WRIST}/to_timestamp"] == 3.5
    table = pq.read_table(recorded / set_files.data_path(2))
    assert set(table.column_names) == {key for key, dtype in dtypes.items() if dtype != "video"}
    assert table["index"].to_pylist() == list(range(140, 210))
    assert table["task_index"].to_pylist() == [0] * 70
    assert table["timestamp"].to_numpy() == pytest.approx(np.arange(70) / FPS, abs=1e-6)
    assert isinstance(table[ft.TRUTH_PROGRESS][0].as_py(), float), "shape (1,) is a scalar column"
    png = table[ft.TACTILE_LEFT].to_pylist()[3]["bytes"]
    pixels = np.asarray(Image.open(io.BytesIO(png)))
    np.testing.assert_array_equal(pixels, make_episode(2, 70).frames[ft.TACTILE_LEFT][3])


def test_statistics_of_the_set_are_of_all_frames(recorded: Path) -> None:
    stats = json.loads((recorded / set_files.STATS).read_text())
    episodes = [make_episode(seed, 70) for seed in range(3)]
    for key, axes, scale in ((ft.ACTION, 0, 1), (ft.TACTILE_LEFT, (0, 1, 2), 255)):
        values = np.concatenate([episode.frames[key] for episode in episodes]).astype(float) / scale
        shape = (3, 1, 1) if scale == 255 else (8,)
        assert stats[key]["count"] == [210]
        for name in ("min", "max", "mean", "std"):
            expected = getattr(values, name)(axis=axes).reshape(shape)
            np.testing.assert_allclose(stats[key][name], expected, rtol=1e-9, atol=1e-12)
        quantile = np.quantile(values, 0.9, axis=axes).reshape(shape)
        np.testing.assert_allclose(stats[key]["q90"], quantile, atol=0.2)
    assert stats["index"]["max"] == [209]


def test_encoded_in_a_worker_and_continued(small: Path) -> None:
    encoded = pickle.loads(pickle.dumps(encode(make_episode(3), FPS)))
    assert EpisodeWriter(small, FPS).append(encoded) == 3
    assert EpisodeWriter(small, FPS).append(make_episode(4)) == 4
    assert validate(small) == []
    assert_holds(small, list(range(5)))


def with_frames(key: str, values: np.ndarray) -> Episode:
    return Episode({**make_episode(9).frames, key: values}, "lift the 1", make_episode(9).meta)


UNFIT = {
    "wrist differ": with_frames(ft.WRIST, np.zeros((7, 32, 64, 3), np.uint8)),
    "convert it to uint8": with_frames(ft.WRIST, np.zeros((7, 32, 48, 3), np.float32)),
    "no key of touchgoal": with_frames("observation.smell", np.zeros((7, 1), np.float32)),
    "has 6 frames": with_frames(ft.ACTION, np.zeros((6, 8), np.float32)),
    "not finite at frame 0": with_frames(ft.ACTION, np.full((7, 8), np.nan, np.float32)),
    "meta differs from the set's in seed": replace(
        make_episode(9), meta={**make_episode(9).meta, "seed": "nine"}
    ),
}


@pytest.mark.parametrize("reason", UNFIT)
def test_an_unfit_episode_leaves_the_set_as_it_was(small: Path, reason: str) -> None:
    writer = EpisodeWriter(small, FPS)
    with pytest.raises(UserError, match=reason):
        writer.append(UNFIT[reason])
    assert validate(small) == []
    assert writer.append(make_episode(3)) == 3


def test_episodes_to_come_are_checked_before_any_work(small: Path) -> None:
    writer = EpisodeWriter(small, FPS)
    shapes = {key: values.shape[1:] for key, values in make_episode(0).frames.items()}
    shapes = {key: shape for key, shape in shapes.items() if not key.startswith("truth.")}
    assert writer.metadata is not None
    writer.metadata.check_fits(small, shapes, "pick-place")
    for key, shape in ((ft.WRIST, (64, 64, 3)), (ft.FRONT, (32, 48, 3)), (ft.STATE, (13,))):
        with pytest.raises(UserError, match=f"{key} is .* in .* the episodes to come"):
            writer.metadata.check_fits(small, shapes | {key: shape}, "pick-place")


def test_refusals_say_what_to_do(small: Path) -> None:
    episodes = EpisodeSet(small)
    with pytest.raises(UserError, match="frames 0 to 6, not -1"):
        episodes.read(0, frames=[0, -1])
    with pytest.raises(UserError, match="20 frames per second, not 30"):
        EpisodeWriter(small, fps=30)
    info = json.loads((small / set_files.INFO).read_text())
    (small / set_files.INFO).write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    for refuse in (EpisodeSet, EpisodeWriter, validate, repair):
        with pytest.raises(UserError, match="version 'v2.1'"):
            refuse(small)


def add_episodes_like_lerobot(root: Path) -> None:
    """Add two episodes to three of 7 frames by extending the last files."""
    extra = root.with_name("extra")
    record(extra, range(3, 5))
    files = ((root, 2), (extra, 0), (extra, 1))
    tables = [pq.read_table(folder / set_files.data_path(i)) for folder, i in files]
    wrist = [EpisodeSet(folder).read(i, [ft.WRIST]).frames[ft.WRIST] for folder, i in files]
    table = pa.concat_tables([t.replace_schema_metadata(None) for t in tables])
    index = np.arange(14, 35)
    for key, values in (("index", index), ("episode_index", index // 7)):
        table = table.set_column(table.column_names.index(key), key, pa.array(values))
    pq.write_table(table, root / set_files.data_path(2), compression="snappy")
    write_video(root / set_files.video_path(ft.WRIST, 2), np.concatenate(wrist), FPS)
    own = pq.read_table(root / set_files.EPISODES).to_pylist()
    added = [
        {
            **{key: value for key, value in own[2].items() if not key.startswith("touchgoal/")},
            "episode_index": i,
            "tasks": [f"lift the {i % 2}"],
            "dataset_from_index": 7 * i,
            "dataset_to_index": 7 * (i + 1),
            f"videos/{ft.WRIST}/from_timestamp": (7 * i - 14) / FPS,
            f"videos/{ft.WRIST}/to_timestamp": (7 * (i + 1) - 14) / FPS,
            f"videos/{ft.WRIST}/crc32": None,
        }
        for i in (3, 4)
    ]
    pq.write_table(pa.Table.from_pylist([*own, *added]), root / set_files.EPISODES)
    info = json.loads((root / set_files.INFO).read_text())
    info |= {"total_episodes": 5, "total_frames": 35, "splits": {"train": "0:5"}}
    (root / set_files.INFO).write_text(json.dumps(info))


def test_a_set_that_lerobot_continued_is_left_as_it_is(small: Path) -> None:
    """It is read; its episodes are sound, if not ours: nothing moves, no message advises `repair`."""
    add_episodes_like_lerobot(small)
    before = {path: path.read_bytes() for path in small.rglob("*") if path.is_file()}
    episodes = EpisodeSet(small)
    for i in range(5):
        read, written = episodes.read(i, frames=[6, 0, 3]), make_episode(i)
        for key in (ft.STATE, *ft.TACTILE):
            np.testing.assert_array_equal(read.frames[key], written.frames[key][[6, 0, 3]])
        off = read.frames[ft.WRIST].astype(int) - written.frames[ft.WRIST][[6, 0, 3]]
        assert np.abs(off).mean() < 8, "lossy"
    assert (episodes.meta(2)["seed"], episodes.meta(3), episodes.task(4)) == (2, {}, "lift the 0")
    for use in (lambda root: EpisodeWriter(root, FPS), validate, repair):
        with pytest.raises(UserError, match="lerobot wrote .* changes nothing here") as error:
            use(small)
        assert "touchgoal repair" not in str(error.value) and "\n" not in str(error.value)
    (small / set_files.INFO).unlink()
    with pytest.raises(UserError, match="lerobot wrote"):
        repair(small)
    del before[small / set_files.INFO]
    assert {path: path.read_bytes() for path in small.rglob("*") if path.is_file()} == before


def test_a_run_folder_will_do(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    shutil.copytree(small, tmp_path / "run" / "episodes")
    assert len(EpisodeSet(tmp_path / "run")) == 3
    assert "taking the episodes in" in capsys.readouterr().err
    assert validate(tmp_path / "run") == []


def test_two_recorders_in_one_folder(tmp_path: Path) -> None:
    """The second is refused before it has done any work; an unused folder goes again."""
    first = EpisodeWriter(tmp_path / "set", FPS)
    with pytest.raises(UserError, match="something else is recording into"):
        EpisodeWriter(tmp_path / "set", FPS)
    first.close()
    assert not (tmp_path / "set").exists()


def test_checksum_tells_sets_apart(recorded_small: Path, small: Path) -> None:
    checksum = EpisodeSet(small).checksum
    assert checksum == EpisodeSet(recorded_small).checksum, "wherever the set lies"
    EpisodeWriter(small, FPS).append(make_episode(3))
    assert EpisodeSet(small).checksum != checksum
    record(small.with_name("other"), range(1, 4))
    assert EpisodeSet(small.with_name("other")).checksum != checksum, "as many, other frames"


def test_video_and_folder_give_the_same_frames(tmp_path: Path) -> None:
    frames = moving_blob(12, 32, 48, 0)
    write_video(tmp_path / "clips" / "a.mp4", frames, 12.5)
    read, fps = read_frames(tmp_path / "clips" / "a.mp4")
    assert fps == 12.5 and read.shape == frames.shape
    assert np.abs(read - frames.astype(int)).mean() < 4
    folder = tmp_path / "pictures"
    folder.mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"view2_{i}.png"), frame[..., ::-1])
    read, fps = read_frames(folder)
    assert fps is None
    np.testing.assert_array_equal(read, frames)


def test_an_append_rewrites_the_last_file_of_the_episodes_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(set_files, "CHUNK", 2)
    record(tmp_path, range(3))
    first = (tmp_path / set_files.EPISODES).stat().st_mtime_ns
    record(tmp_path, range(3, 5))
    assert_holds(tmp_path, [0, 1, 2, 3, 4])
    assert (tmp_path / set_files.EPISODES).stat().st_mtime_ns == first
    rows = pq.read_table(tmp_path / "meta/episodes").to_pylist()
    assert [row["meta/episodes/file_index"] for row in rows] == [0, 0, 1, 1, 0]
    assert [row["meta/episodes/chunk_index"] for row in rows] == [0, 0, 0, 0, 1]
    assert validate(tmp_path) == [] and not EpisodeSet(tmp_path).foreign
    (tmp_path / set_files.episodes_path(1)).unlink()
    with pytest.raises(UserError, match="it lists 3 of 5 episodes"):
        EpisodeSet(tmp_path)
    assert repair(tmp_path) and validate(tmp_path) == []
    assert_holds(tmp_path, [0, 1, 2, 3, 4])


@pytest.mark.parametrize(
    ("frames", "shared", "refused"),
    [
        (1, 0, 0),
        (1, 1, 1),
        (10, 1, 0),
        (10, 2, 1),
        (40, 3, 0),
        (40, 4, 1),
        (400, 39, 0),
        (400, 40, 1),
    ],
)
def test_sets_that_share_a_tenth_of_an_episode_are_no_two_sets(
    frames: int, shared: int, refused: bool
) -> None:
    """At least two frames of it; simulated episodes may begin alike."""
    copy = frozenset(range(-shared, frames - shared))
    with pytest.raises(UserError, match=f"shares {shared}") if refused else nullcontext():
        require_disjoint([("a", frozenset(range(-frames, 0)))], [("b", copy)])

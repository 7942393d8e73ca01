"""Published data of others: touch, labels, and pickles that are read without running them."""

import os
import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from published_files import (
    UNTOUCHED,
    encoded,
    gel,
    near,
    write,
    write_force_batch,
    write_grasps,
    write_pose_set,
    write_slides,
)

from benchmarks.published_touch.feeling_of_success import read_grasps
from benchmarks.published_touch.tacbench_forces import read_strokes
from benchmarks.published_touch.tacbench_poses import read_bags
from touchgoal.episodes.importers.plain_pickle import read_plain_pickle
from touchgoal.episodes.importers.pretraining_clips import read_recordings
from touchgoal.runtime.errors import UserError


def test_slides_are_upright_digits_with_their_own_untouched_gel(tmp_path: Path) -> None:
    write_slides(tmp_path)
    recordings = read_recordings(tmp_path)
    assert [r.held_out for r in recordings] == 2 * [False, False, False, False, True]
    assert [len(r.open()[0]) for r in recordings] == 2 * [8, 9, 10, 11, 12]
    for k, light in ((0, "red"), (1, "blue")):
        clip, background = recordings[5 * k + 2].open()
        assert clip.sensor == "digit"
        frames = clip.frames([3, 0])
        assert frames.shape == (2, 320, 240, 3)
        assert near(frames[0], gel(100 * k + 23, light=light))
        assert near(background, np.full((320, 240, 3), UNTOUCHED[light]))
    for path in (tmp_path / "bgs").iterdir():
        path.unlink()  # then a recording's usual image is its background: bumps are nowhere twice
    background = read_recordings(tmp_path)[0].open()[1]
    assert near(background, np.full((320, 240, 3), UNTOUCHED["red"]))


def test_a_lying_digit_is_turned_upright(tmp_path: Path) -> None:
    upright = gel(1)
    lying = np.rot90(upright)  # what a clockwise quarter turn brings back
    for i in range(2):
        write(tmp_path / "mug" / f"dataset_{i}.pkl", [encoded(lying, "PNG")])
    assert np.array_equal(read_recordings(tmp_path)[0].open()[0].frames([0])[0], upright)


def test_touch_and_go_has_red_and_blue_put_back(tmp_path: Path) -> None:
    """The set's converter gave RGB to OpenCV's writer, which takes BGR."""
    clips = {f"2022041{i}_031604.pkl": 3 + i for i in range(4)}
    for name, count in clips.items():
        images = [gel(t, (480, 640)) for t in range(count)]
        stored = [cv2.imencode(".jpg", image)[1].tobytes() for image in images]
        write(tmp_path / name, stored)
    recordings = read_recordings(tmp_path)
    assert {r.sensor for r in recordings} == {"gelsight_markers"}
    assert [r.held_out for r in recordings] == [True, False, False, False]  # the shortest quarter
    assert near(recordings[2].open()[0].frames([4])[0], gel(4, (480, 640)))
    assert read_recordings(tmp_path, "gelsight")[0].sensor == "gelsight"


def test_what_is_no_such_folder_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="none of the published layouts"):
        read_recordings(tmp_path)
    write(tmp_path / "001.pkl", [encoded(gel(1))])
    with pytest.raises(UserError, match="one recording: training and validation"):
        read_recordings(tmp_path)
    write(tmp_path / "002.pkl", {"gelsightA_before": [b""]})
    with pytest.raises(UserError, match="is not a list of encoded images"):
        read_recordings(tmp_path)
    write(tmp_path / "002.pkl", [encoded(gel(1)), encoded(gel(1, (240, 240)))])
    with pytest.raises(UserError, match="images of different sizes"):
        read_recordings(tmp_path)[1].open()[0].frames([0, 1])


def test_strokes_have_their_images_forces_and_slips(tmp_path: Path) -> None:
    labels = write_force_batch(tmp_path / "sphere" / "batch_1", strokes=2)
    strokes = list(read_strokes(tmp_path))
    assert [s.name for s in strokes] == ["sphere/batch_1/0", "sphere/batch_1/1"]
    assert {s.probe for s in strokes} == {"sphere"}
    for i, stroke in enumerate(strokes):
        assert stroke.clip.sensor == "digit"
        true = labels[i]["forces"] * (1, 1, -1)  # pressing is positive
        assert np.array_equal(stroke.force, true) and stroke.force[-1, 2] == 3.0
        assert stroke.slip.tolist() == [False] * 4 + [True] * 2
        assert np.array_equal(stroke.frames()[5], gel(10 * i + 5))  # over the end of the first file
        assert np.array_equal(stroke.background(), np.full((320, 240, 3), UNTOUCHED["red"]))
        assert stroke.untouched == 8 * i + 1  # the last before it
    assert len(list(read_strokes(tmp_path / "sphere" / "batch_1"))) == 2


def test_a_mini_lies_and_a_batch_of_exchanged_colours_is_mended(tmp_path: Path) -> None:
    for name, light in (("batch_1", "red"), ("batch_2", "blue")):
        write_force_batch(tmp_path / "sharp" / name, "gelsight", light=light, late=5)
    first, _, second, _ = read_strokes(tmp_path)
    assert first.clip.sensor == "gelsight_mini" and len(first.force) == len(first.rows) == 1
    assert first.frames().shape == (1, 240, 320, 3)
    assert np.array_equal(first.frames()[0], np.rot90(gel(0)))
    assert second.background().mean((0, 1)).tolist() == list(UNTOUCHED["blue"])[::-1]
    dotted = next(read_strokes(tmp_path, "gelsight_mini_markers"))
    assert dotted.clip.sensor == "gelsight_mini_markers"
    with pytest.raises(UserError, match="with gelsight_mini or gelsight_mini_markers, not digit"):
        next(read_strokes(tmp_path, "digit"))


def test_bags_have_motions_in_metres_and_radians(tmp_path: Path) -> None:
    write_pose_set(tmp_path)
    bags = list(read_bags(tmp_path))
    assert [b.object for b in bags] == 2 * (2 * ["pringles"] + 2 * ["sugar"])
    assert [b.held_out for b in bags] == 4 * [False] + 4 * [True]
    bag = bags[0]
    assert len(bag.clip) == len(bag.change) == 8  # one pose more than images
    assert bag.change[6] == pytest.approx([0.6e-3, -1.2e-3, np.radians(0.4)])
    assert near(bag.clip.frames([6])[0], gel(6)) and bag.clip.sensor == "digit"
    assert np.array_equal(bag.background(), np.full((320, 240, 3), UNTOUCHED["red"]))
    path = tmp_path / "test" / "sugar" / "bag_00.pkl"
    whole = pickle.loads(path.read_bytes())
    write(path, whole | {"object_ring_rel_pose_n5": 2 * whole["object_ring_rel_pose_n5"]})
    with pytest.raises(UserError, match="no rigid motions"):
        list(read_bags(tmp_path))


def test_grasps_are_held_or_not_and_felt_by_two_fingers(tmp_path: Path) -> None:
    write_grasps(tmp_path / "029.pkl", [True, False])
    write_grasps(tmp_path / "030.pkl", [False])
    trials = list(read_grasps(tmp_path))
    assert {t.object for t in trials} == {"mug"}
    assert [t.held for t in trials] == [True, False, False]
    assert [t.held_out for t in trials] == [False, False, True]
    for f, finger in enumerate(trials[1].fingers):
        assert finger.sensor == "gelsight"
        for m, frame in enumerate(finger.frames(range(3))):
            assert near(frame, gel(100 + 10 * f + m, (240, 320)))  # red and blue put back
    value = pickle.loads((tmp_path / "030.pkl").read_bytes())
    write(tmp_path / "030.pkl", value | {"is_gripping": [True, False]})
    with pytest.raises(UserError, match="of different lengths"):
        list(read_grasps(tmp_path))


VALUE = {
    "pictures": [bytes([i]) * (100 * i) for i in range(5)],
    "trajectories": {
        0: {"forces": np.arange(12.0).reshape(4, 3), "slip": np.array([True, False])},
        1: {"forces": np.asfortranarray(np.arange(6, dtype=">f4").reshape(2, 3)), "slip": []},
    },
    "plain": [None, True, -1, 70_000, 2**40, 0.5, "wörter", (), (1, 2, 3, "vier")],
    "of numpy": [np.float64(2.5), np.bool_(True), np.int32(-7), np.bytes_(b"mug"), np.str_("mug")],
}


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_plain_values_are_read(tmp_path: Path, protocol: int) -> None:
    path = tmp_path / "values.pkl"
    path.write_bytes(pickle.dumps(VALUE, protocol))
    assert repr(read_plain_pickle(path)) == repr(pickle.loads(path.read_bytes()))
    # numpy 1 named its core differently
    path.write_bytes(pickle.dumps(np.arange(3.0), 3).replace(b"numpy._core.", b"numpy.core."))
    assert np.array_equal(read_plain_pickle(path), np.arange(3.0))


class Hostile:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch /tmp/it_ran",)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (pickle.dumps(Hostile()), r"asks for posix\.system"),
        (b"\x80\x03(ios\nsystem\n.", r"asks for os\.system"),
        (b"\x80\x04\x8c\x02o\n\x8c\x06system\x93.", r"asks for o\\n\.system"),
        (b"", "no pickle of plain values"),
        (pickle.dumps(VALUE) + b"more", "damaged"),
    ],
)
def test_anything_else_is_one_line(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "theirs.pkl"
    with pytest.raises(UserError, match="cannot be read"):
        read_plain_pickle(path)
    path.write_bytes(data)
    with pytest.raises(UserError, match=message) as refused:
        read_plain_pickle(path)
    assert "\n" not in str(refused.value)
    assert not Path("/tmp/it_ran").exists()


@pytest.mark.parametrize(
    ("lost", "message"),
    [("digit_01", "10 images, .* labels 16: get all its files"), ("slip_forces", "is missing")],
)
def test_a_batch_that_is_not_whole_is_one_line(tmp_path: Path, lost: str, message: str) -> None:
    write_force_batch(tmp_path / "sphere" / "batch_1")
    (tmp_path / "sphere" / "batch_1" / f"dataset_{lost}.pkl").unlink()
    with pytest.raises(UserError, match=message):
        next(read_strokes(tmp_path))

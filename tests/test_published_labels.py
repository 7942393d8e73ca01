"""Published touch with labels: force and slip, pose, grasps; whole, damaged, incomplete."""

import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from published_files import (
    UNTOUCHED,
    gel,
    near,
    write,
    write_force_batch,
    write_grasps,
    write_pose_set,
)

from touchgoal.episodes.importers.feeling_of_success import read_grasps
from touchgoal.episodes.importers.tacbench_forces import read_strokes
from touchgoal.episodes.importers.tacbench_poses import read_bags
from touchgoal.runtime.errors import UserError


def test_strokes_have_their_pictures_forces_and_slips(tmp_path: Path) -> None:
    labels = write_force_batch(tmp_path / "sphere" / "batch_1", strokes=2)
    strokes = list(read_strokes(tmp_path))
    assert [(s.name, s.probe) for s in strokes] == [
        ("sphere/batch_1/0", "sphere"),
        ("sphere/batch_1/1", "sphere"),
    ]
    for i, stroke in enumerate(strokes):
        assert stroke.clip.sensor == "digit"
        true = labels[i]["forces"] * (1, 1, -1)  # pressing is positive
        assert np.array_equal(stroke.force, true) and stroke.force[-1, 2] == 3.0
        assert stroke.slip.tolist() == [False] * 4 + [True] * 2
        assert np.array_equal(stroke.frames()[5], gel(10 * i + 5))  # over the end of the first file
        assert np.array_equal(stroke.background(), np.full((320, 240, 3), UNTOUCHED["red"]))
        assert stroke.untouched == 8 * i + 1  # the last before it
    assert len(list(read_strokes(tmp_path / "sphere"))) == 2
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


def test_a_batch_that_is_not_whole_is_one_line(tmp_path: Path) -> None:
    batch = tmp_path / "sphere" / "batch_1"
    with pytest.raises(UserError, match="give a folder of TacBench's force estimation"):
        next(read_strokes(tmp_path))
    write_force_batch(batch)
    (batch / "dataset_digit_01.pkl").unlink()
    with pytest.raises(UserError, match="10 images, .* labels 16: get all its files"):
        next(read_strokes(tmp_path))
    write_force_batch(batch)
    (batch / "dataset_slip_forces.pkl").unlink()
    with pytest.raises(UserError, match="dataset_slip_forces.pkl is missing"):
        next(read_strokes(tmp_path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.pop("trajectories"), "has no 'trajectories'"),
        (lambda v: v.update(trajectories={}), "has no stroke"),
        (lambda v: v.update(in_contact=np.ones(16)), "labelled as without contact"),
        (lambda v: v.update(in_contact=["yes"] * 16), "no plain numbers"),
        (lambda v: v["trajectories"][0].pop("forces"), "stroke 0 in .* has no 'forces'"),
        (lambda v: v["trajectories"][0].update(forces=np.full((6, 3), np.nan)), "not all between"),
        (
            lambda v: v["trajectories"][0].update(forces=np.full((6, 3), 1e9)),
            "between -100 and 100",
        ),
        (
            lambda v: v["trajectories"][0].update(forces=np.zeros((6, 2))),
            r"shape \(6, 2\), not \(n, 3",
        ),
        (lambda v: v["trajectories"][0].update(forces=[[1.0], [1.0, 2.0]]), "no plain numbers"),
        (
            lambda v: v["trajectories"][0].update(indexes=np.arange(16, 22)),
            "whole numbers from 0 to 15",
        ),
        (lambda v: v["trajectories"][0].update(indexes=np.arange(3)), "3 images, 6 forces"),
        (lambda v: v["trajectories"][0].update(slip_label=np.full(6, 2)), "from 0 to 1"),
    ],
)
def test_wrong_labels_are_one_line(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    batch = tmp_path / "sphere" / "batch_1"
    write_force_batch(batch)
    value = pickle.loads((batch / "dataset_slip_forces.pkl").read_bytes())
    change(value)
    write(batch / "dataset_slip_forces.pkl", value)
    with pytest.raises(UserError, match=message) as refused:
        list(read_strokes(tmp_path))
    assert "\n" not in str(refused.value)


def test_bags_have_motions_in_metres_and_radians(tmp_path: Path) -> None:
    write_pose_set(tmp_path)
    bags = list(read_bags(tmp_path))
    assert [(b.object, b.held_out) for b in bags] == [
        (name, held_out)
        for held_out in (False, True)
        for name in ("pringles", "sugar")
        for _ in "ab"
    ]
    bag = bags[0]
    assert len(bag.clip) == len(bag.change) == 8  # one pose more than pictures
    assert bag.change[6] == pytest.approx([0.6e-3, -1.2e-3, np.radians(0.4)])
    assert near(bag.clip.frames([6])[0], gel(6)) and bag.clip.sensor == "digit"
    assert np.array_equal(bag.background(), np.full((320, 240, 3), UNTOUCHED["red"]))
    with pytest.raises(UserError, match=r"digit_index\.png is missing"):
        next(read_bags(tmp_path, "index"))
    with pytest.raises(UserError, match="with digit, not gelsight"):
        next(read_bags(tmp_path, sensor="gelsight"))
    path = tmp_path / "test" / "sugar" / "bag_00.pkl"
    whole = pickle.loads(path.read_bytes())
    write(path, whole | {"object_ring_rel_pose_n5": 2 * whole["object_ring_rel_pose_n5"]})
    with pytest.raises(UserError, match="no rigid motions"):
        list(read_bags(tmp_path))
    write(path, {"digit_ring": whole["digit_ring"]})
    with pytest.raises(UserError, match="bag_00.pkl has no 'object_ring_rel_pose_n5'"):
        list(read_bags(tmp_path))
    with pytest.raises(UserError, match="give the folder of TacBench's pose estimation"):
        next(read_bags(tmp_path / "train"))


def test_grasps_are_held_or_not_and_felt_by_two_fingers(tmp_path: Path) -> None:
    write_grasps(tmp_path / "029.pkl", [True, False])
    write_grasps(tmp_path / "030.pkl", [False])
    trials = list(read_grasps(tmp_path))
    assert [(t.object, t.held, t.held_out) for t in trials] == [
        ("mug", True, False),
        ("mug", False, False),
        ("mug", False, True),
    ]
    for f, finger in enumerate(trials[1].fingers):
        assert finger.sensor == "gelsight"
        for m, frame in enumerate(finger.frames(range(3))):
            assert near(frame, gel(100 + 10 * f + m, (240, 320)))  # red and blue put back
    value = pickle.loads((tmp_path / "030.pkl").read_bytes())
    write(tmp_path / "030.pkl", value | {"is_gripping": [True, False]})
    with pytest.raises(UserError, match="of different lengths"):
        list(read_grasps(tmp_path))
    write(tmp_path / "030.pkl", value | {"is_gripping": ["yes"]})
    with pytest.raises(UserError, match="no plain numbers"):
        list(read_grasps(tmp_path))
    with pytest.raises(UserError, match="give a folder of Feeling of Success"):
        next(read_grasps(tmp_path / "none"))


def use_strokes(folder: Path) -> None:
    for stroke in read_strokes(folder):
        assert np.isfinite(stroke.force).all() and len(stroke.force) == len(stroke.slip)
        assert stroke.clip.pictures[int(stroke.rows.max())]


def use_bags(folder: Path) -> None:
    for bag in read_bags(folder):
        assert np.isfinite(bag.change).all() and len(bag.change) == len(bag.clip)


def use_all(found: Iterable[Any]) -> None:
    for item in found:
        assert str(item.name).encode()  # what a terminal can show


@pytest.mark.parametrize("layout", ["force", "pose", "grasps"])
def test_whatever_byte_is_wrong_labels_are_read_or_refused(tmp_path: Path, layout: str) -> None:
    if layout == "force":
        path = tmp_path / "sphere" / "batch_1" / "dataset_slip_forces.pkl"
        write_force_batch(path.parent)
    elif layout == "pose":
        path = tmp_path / "train" / "sugar" / "bag_00.pkl"
        write_pose_set(tmp_path, bags=1)
    else:
        path = tmp_path / "000.pkl"
        write_grasps(path, [True, False])
    use = {
        "force": use_strokes,
        "pose": use_bags,
        "grasps": lambda folder: use_all(read_grasps(folder)),
    }[layout]
    use(tmp_path)
    data = path.read_bytes()
    rng = np.random.default_rng(2)
    pictures = [at for at in range(len(data)) if data[at : at + 3] == b"\xff\xd8\xff"]
    places = rng.permutation(len(data))[:40]
    if pictures:  # most bytes are theirs; here those about them count
        about = [at + k for at in pictures for k in range(-12, 4)] + list(range(60))
        tail = list(range(max(len(data) - 1500, 0), len(data)))
        places = np.concatenate([places, rng.permutation(about + tail)[:120]])
    else:
        places = rng.permutation(len(data))[:150]
    for at in places:
        broken = bytearray(data)
        broken[at] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        try:
            use(tmp_path)
        except UserError as refused:
            assert "\n" not in str(refused)

"""Published sets of real touch in small: their readers, and the tables made from them."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchgoal.benchmarks.papers.mmwand import classification, retrieval
from touchgoal.benchmarks.papers.mmwand.real import dome_set, dome_tables, zero_shot
from touchgoal.episodes.importers.touch_sets.objectfolder_real import (
    read_objectfolder_real,
    read_touches,
)
from touchgoal.episodes.importers.touch_sets.vt60 import (
    inside_dome,
    is_vt60,
    outside_dome,
    read_vt60,
)
from touchgoal.runtime.errors import UserError

CLASSES, OBJECTS, TOUCHES, VIEWS = 2, 4, 8, 4


def write_table(path: Path, *rows: tuple[object, ...]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def write_picture(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture.astype(np.uint8))


@pytest.fixture(scope="module")
def dome(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two classes, felt as a bright or a dark blob and seen as a green or a red square."""
    root, rng = tmp_path_factory.mktemp("vt60"), np.random.default_rng(0)
    untouched = np.full((128, 128, 3), 120.0)
    write_picture(root / "untouched.jpg", untouched)
    objects, touches = [("object", "class")], [("file", "object")]
    for kind in range(CLASSES):
        for k in range(OBJECTS):
            name = f"{'ab'[kind]}_{k}"
            objects.append((name, "ab"[kind]))
            for i in range(TOUCHES):
                picture = untouched + rng.normal(0, 1, untouched.shape)
                at = tuple(int(v) for v in rng.integers(50, 70, 2))
                cv2.circle(picture, at, 12, (190 - 140 * kind,) * 3, -1)
                write_picture(root / "touch" / name / f"{i}.jpg", picture)
                touches.append((f"touch/{name}/{i}.jpg", name))
            for i in range(VIEWS):
                view = rng.normal(128, 5, (64, 64, 3))
                view[16:48, 16:48, 1 + kind] = 250
                write_picture(root / "views" / name / f"{i}.jpg", view)
    write_table(root / "objects.csv", *objects)
    write_table(root / "touches.csv", *touches)
    return root


def test_the_dome_set_is_read(dome: Path, tmp_path: Path) -> None:
    data = read_vt60(dome)
    assert is_vt60(dome) and not is_vt60(tmp_path)
    assert data.names[5] == "b_1" and data.classes == ("a", "b") and data.kind[5] == 1
    assert len(data.touches) == CLASSES * OBJECTS * TOUCHES
    for path, k in zip(data.views, data.view_object, strict=True):
        assert path.parent.name == data.names[k]
    assert not outside_dome(128, 128)[inside_dome(128, 128)].any()
    write_table(tmp_path / "objects.csv", ("object", "class"), ("a", "b"))
    write_table(tmp_path / "touches.csv", ("file", "object"), ("touch/a/0.jpg", "a"))
    with pytest.raises(UserError, match=r"untouched\.jpg, which is not there"):
        read_vt60(tmp_path)


@pytest.mark.parametrize("split", dome_tables.SPLITS)
def test_every_row_is_tested_once_and_never_trained_on(
    dome: Path, split: dome_set.DomeSplit
) -> None:
    data = read_vt60(dome)
    found = list(dome_set.folds(data, split, 0))
    tested = np.concatenate([fold.test_touch for fold in found])
    assert sorted(tested) == list(range(len(data.touches)))
    for fold in found:
        assert not set(fold.train_touch) & set(fold.test_touch)
        assert not set(fold.train_view) & set(fold.test_view)
        train = {*data.touch_object[fold.train_touch], *data.view_object[fold.train_view]}
        test = {*data.touch_object[fold.test_touch], *data.view_object[fold.test_view]}
        assert split != "object" or not train & test
        assert set(data.kind[list(test)]) == {0, 1}


def test_touch_finds_sight_of_unseen_objects(dome: Path, tmp_path: Path) -> None:
    """Classes that differ by touch and sight are found; light outside the dome, which is equal, is not."""
    result = retrieval.run(retrieval.Config(data=dome, cache=tmp_path))
    rows = {(row["split"], row["input"]): row for row in result["rows"]}
    direction = "touch to image"
    assert rows["object", dome_set.SHIPPED][direction][0] > 99
    assert rows["object", dome_set.PIXELS][direction][0] > 99
    chance = rows["object", "chance"][direction][0]
    assert chance < 70 and rows["object", dome_set.OUTSIDE][direction][0] < 80
    assert "raw pixels" in result["table"]
    classified = classification.run(classification.Config(data=dome, cache=tmp_path))["rows"]
    [shipped] = [row for row in classified if row["input"] == dome_set.SHIPPED]
    assert shipped["both"][0] == 100
    assert len(list(tmp_path.glob("dome-*.npz"))) == 1  # embedded once


def test_objectfolder_real(tmp_path: Path) -> None:
    rows: list[tuple[object, ...]] = [("index", "name", "material")]
    materials = ("Steel", "Wood", "Steel", "")
    for i, material in enumerate(materials, 1):
        picture = np.full((320, 240, 3), 100.0)
        picture[:10, :, 2] = 40 * i  # red at the top
        write_picture(tmp_path / "touch" / f"{i:03d}.png", picture)
        rows.append((i, f"object_{i}", material))
    write_table(tmp_path / "objects.csv", *rows)
    write_picture(tmp_path / "picture" / "002.jpg", np.zeros((8, 8, 3)))
    objects = read_objectfolder_real(tmp_path)
    assert [item.material for item in objects] == ["steel", "wood", "steel", None]
    assert [item.picture is not None for item in objects] == [False, True, False, False]
    touches, untouched = read_touches(objects)
    assert touches.shape == (4, 240, 320, 3) and touches[3, 0, 0, 0] == 160  # RGB, turned left
    assert untouched[0, 0, 0] == 100
    result = zero_shot.run(zero_shot.Config(data=tmp_path))
    assert "the most frequent material" in result["table"] and "0.67" in result["table"]

"""MMWand's Tables II and IV on real touches of a dome: retrieval and classification in four folds.

Touch and sight each get a linear head, a ridge to the training objects' classes (whole objects held
out) or to the objects (presses held out); both heads' answers are compared by cosine. The strength
of each ridge is chosen on a quarter of the training side, held out in the same way.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.papers.mmwand.intervals import Interval, cell, mean_over_objects
from benchmarks.papers.mmwand.real.dome_set import (
    INPUTS,
    PIXELS,
    DomeFold,
    DomeSet,
    DomeSplit,
    embed_dome,
    folds,
)
from touchgoal.encoders.alignment.retrieval import average_precisions
from touchgoal.encoders.probes.ridge import ridge_scores
from touchgoal.rewards.report.text_table import aligned

SPLITS: tuple[DomeSplit, ...] = ("press", "object")
_STRENGTHS = (0.01, 0.1, 1.0)
_NEAREST = "nearest raw pixels, no head"


@dataclass(frozen=True, eq=False)
class _Answers:
    """Head outputs for the test side of a fold."""

    touch: Float[np.ndarray, "b c"]
    image: Float[np.ndarray, "d c"]
    both: Float[np.ndarray, "b c"]  # each touch with one view of its object


def run_retrieval(folder: Path, seed: int, cache: Path) -> dict[str, Any]:
    """Return the table of retrieval between touch and image."""
    data, rows = embed_dome(folder, seed, cache), []
    for split in SPLITS:
        for name in (*INPUTS, _NEAREST, "chance"):
            found = _retrieve(data, name, split, seed)
            rows.append({"split": split, "input": name, **found})
    return {"table": _retrieval_table(data, rows), "rows": rows}


def run_classification(folder: Path, seed: int, cache: Path) -> dict[str, Any]:
    """Return the table of classes by image, touch and both, on objects that were left out."""
    data, rows = embed_dome(folder, seed, cache), []
    for name in INPUTS:
        rows.append({"input": name, **_classify(data, name, seed)})
    return {"table": _classification_table(data, rows), "rows": rows}


def _retrieve(data: DomeSet, name: str, split: DomeSplit, seed: int) -> dict[str, Interval]:
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for fold in folds(data.listed, split, seed):
        touch_object = data.listed.touch_object[fold.test_touch]
        view_object = data.listed.view_object[fold.test_view]
        if name == "chance":
            cosine = np.zeros((len(touch_object), len(view_object)))
        elif name == _NEAREST:
            cosine = _nearest_touch(data, fold)
        else:
            answers = _answer(data, name, fold, split)
            cosine = _unit(answers.touch) @ _unit(answers.image).T
        kinds = np.unique(touch_object)
        right = touch_object[:, None] == view_object
        of_object = np.stack([cosine[touch_object == k].mean(0) for k in kinds])
        for direction, s, r, asked in (
            ("touch to image", cosine, right, touch_object),
            ("image to touch", cosine.T, right.T, view_object),
            ("object's touches to image", of_object, kinds[:, None] == view_object, kinds),
            (
                "image to object's touches",
                of_object.T,
                view_object[:, None] == kinds,
                view_object,
            ),
        ):
            found.setdefault(direction, []).append((asked, average_precisions(s, r)))
    return {direction: _mean(pairs) for direction, pairs in found.items()}


def _nearest_touch(data: DomeSet, fold: DomeFold) -> Float[np.ndarray, "b d"]:
    """Return cosines of test views to the mean view of the nearest training touch's object."""
    listed, pixels = data.listed, _unit(data.touch[PIXELS])
    found = (pixels[fold.test_touch] @ pixels[fold.train_touch].T).argmax(1)
    mean = np.zeros((len(listed.names), data.image.shape[1]), np.float32)
    np.add.at(mean, listed.view_object[fold.train_view], data.image[fold.train_view])
    nearest = listed.touch_object[fold.train_touch[found]]
    return _unit(mean[nearest]) @ data.image[fold.test_view].T


def _classify(data: DomeSet, name: str, seed: int) -> dict[str, Interval]:
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for fold in folds(data.listed, "object", seed):
        answers = _answer(data, name, fold, "object")
        touch_object = data.listed.touch_object[fold.test_touch]
        view_object = data.listed.view_object[fold.test_view]
        for what, scores, objects in (
            ("image", answers.image, view_object),
            ("touch", answers.touch, touch_object),
            ("both", answers.both, touch_object),
        ):
            hit = scores.argmax(1) == data.listed.kind[objects]
            found.setdefault(what, []).append((objects, hit.astype(float)))
    return {what: _mean(pairs) for what, pairs in found.items()}


def _answer(data: DomeSet, name: str, fold: DomeFold, split: DomeSplit) -> _Answers:
    touch, image, listed = data.touch[name], data.image, data.listed
    answer_touch = _fitted(
        touch, listed.touch_object, listed.kind, fold.train_touch, fold.test_touch, split
    )
    answer_image = _fitted(
        image, listed.view_object, listed.kind, fold.train_view, fold.test_view, split
    )
    own = [
        np.flatnonzero(listed.view_object[fold.test_view] == k)
        for k in listed.touch_object[fold.test_touch]
    ]
    view = np.array([rows[i % len(rows)] for i, rows in enumerate(own)])
    return _Answers(answer_touch, answer_image, answer_touch + answer_image[view])


def _fitted(
    x: Float[np.ndarray, "n d"],
    objects: Int[np.ndarray, " n"],
    kind: Int[np.ndarray, " k"],
    train: Int[np.ndarray, " a"],
    test: Int[np.ndarray, " b"],
    split: DomeSplit,
) -> Float[np.ndarray, "b c"]:
    """Fit a ridge on the training rows with the strength that does best on a part of them."""
    target = kind[objects] if split == "object" else objects
    onehot = np.eye(target.max() + 1)[target]
    held = _held(objects[train], kind, split)
    fit, check = train[~held], train[held]
    right = [
        (ridge_scores(x[fit], onehot[fit], x[check], s).argmax(1) == target[check]).mean()
        for s in _STRENGTHS
    ]
    strength = _STRENGTHS[int(np.argmax(right))]
    return ridge_scores(x[train], onehot[train], x[test], strength)


def _held(
    objects: Int[np.ndarray, " n"], kind: Int[np.ndarray, " k"], split: DomeSplit
) -> Bool[np.ndarray, " n"]:
    """Hold out the first object of each class, or every fourth row."""
    if split == "press":
        return np.arange(len(objects)) % 4 == 0
    names = np.unique(objects)
    first = names[np.unique(kind[names], return_index=True)[1]]
    return np.isin(objects, first)


def _unit(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)


def _mean(pairs: list[tuple[np.ndarray, np.ndarray]]) -> Interval:
    return mean_over_objects(*(np.concatenate(column) for column in zip(*pairs, strict=True)))


def _retrieval_table(data: DomeSet, rows: list[dict[str, Any]]) -> str:
    listed = data.listed
    directions = [key for key in rows[0] if key not in ("split", "input")]
    lines = [
        f"{len(listed.touches)} touches and {len(listed.views)} views of {len(listed.names)} objects "
        f"of {len(listed.classes)} classes; mAP in % over four folds [95 % over objects]",
        "object's touches: the mean cosine over an object's held-out touches",
        "nearest raw pixels: the views of the nearest training touch's object stand for a touch",
        "pixels outside the sensor feel nothing: what they find is the light of the session",
    ]
    for split in SPLITS:
        own = (row for row in rows if row["split"] == split)
        cells = [[row["input"], *(cell(row[d]) for d in directions)] for row in own]
        lines += ["", *aligned([[f"split by {split}", *directions], *cells])]
    return "\n".join(lines)


def _classification_table(data: DomeSet, rows: list[dict[str, Any]]) -> str:
    kinds = len(data.listed.classes)
    title = (
        f"right one of {kinds} classes on objects that were left out, % over four folds "
        f"[95 % over objects]; chance {100 / kinds:.0f}"
    )
    inputs = "image", "touch", "both"
    cells = [[row["input"], *(cell(row[what]) for what in inputs)] for row in rows]
    return "\n".join([title, *aligned([["touch by", *inputs], *cells])])

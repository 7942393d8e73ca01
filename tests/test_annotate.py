"""The VisGel pipeline: 20 synthetic recordings with known answers, real classes with random weights, a kill."""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from visgel_scenes import (
    CONTACT,
    KnownBoxes,
    Scene,
    make_captioner,
    make_detector,
    make_scene,
    sensor_box,
    write_scene,
)

from touchgoal.encoders.annotation.annotate import annotate_all
from touchgoal.encoders.annotation.boxes import iou
from touchgoal.encoders.annotation.config import AnnotationSettings
from touchgoal.encoders.annotation.records import (
    AnnotatedTouch,
    annotated_touches,
    open_annotations,
    read_annotations,
)
from touchgoal.episodes.importers.visgel import read_visgel_list
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError

FAULTS = ["no touch"] * 3 + ["missed"] * 2 + ["unsure", "no sensor"] + [""] * 13
REASONS = {
    "no touch": "not enough deformation: the sensor touches nothing",
    "missed": "low overlap: no detected object is where the sensor touches",
    "unsure": "low confidence: no object was detected",
    "no sensor": "low confidence: the sensor was not detected",
}
SETTINGS = AnnotationSettings()


@dataclass
class Set:
    root: Path
    scenes: list[Scene]
    list: Path

    def models(self) -> KnownBoxes:
        return KnownBoxes(self.root, self.scenes)

    def annotate(self, out: Path, models: KnownBoxes, first: int | None = None) -> dict:
        out.mkdir(exist_ok=True)
        return annotate_all(read_visgel_list(self.list)[:first], self.root, models, SETTINGS, out)


@pytest.fixture(scope="module")
def twenty(tmp_path_factory: pytest.TempPathFactory) -> Set:
    root, rng = tmp_path_factory.mktemp("visgel"), np.random.default_rng(7)
    scenes = [make_scene(i, fault, rng) for i, fault in enumerate(rng.permutation(FAULTS).tolist())]
    lines = [line for scene in scenes for line in write_scene(root, scene, rng)]
    path = root / "data_lst" / "train_vision2touch.txt"
    path.parent.mkdir()
    path.write_text("\n".join(rng.permutation(lines).tolist()) + "\n")  # shuffled, as for training
    return Set(root, scenes, path)


@pytest.fixture(scope="module")
def annotated(
    twenty: Set, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict, KnownBoxes]:
    out, models = tmp_path_factory.mktemp("out"), twenty.models()
    return out, twenty.annotate(out, models), models


def by_recording(out: Path) -> dict[str, AnnotatedTouch]:
    return {Path(r.name).name: r for r in read_annotations(out / "annotations.jsonl")}


def test_frames_and_instances_of_twenty_scenes(twenty: Set, annotated: tuple) -> None:
    out, metrics, models = annotated
    found = by_recording(out)
    assert found.keys() == {scene.name for scene in twenty.scenes if not scene.fault}
    for scene in twenty.scenes:
        if scene.fault:
            continue
        record = found[scene.name]
        assert record.contact.image.endswith(scene.contact_image)
        assert record.touch.endswith(f"frame{CONTACT:04d}.png") and "/touch/" in record.touch
        assert record.image.endswith("frame0000.png") and "/vision/" in record.image
        assert iou(record.contact.sensor, sensor_box(scene, CONTACT)) > 0.6
        touched = record.instances[record.touched]
        assert iou(touched.box, scene.boxes[scene.touched]) > 0.6
        assert record.object == touched.caption == f"a {scene.colours[scene.touched]}"
        assert all(instance.caption and instance.score >= 0.3 for instance in record.instances)
        assert record.provenance == {**KnownBoxes.names, **SETTINGS.as_json()}
        assert record.contact.deformation > record.contact.threshold > 0
    assert models.captioned == metrics["instances"] == sum(len(r.instances) for r in found.values())


def test_left_out_is_said_with_its_reason(twenty: Set, annotated: tuple) -> None:
    out, metrics, _ = annotated
    lines = [json.loads(line) for line in (out / "left_out.jsonl").read_text().splitlines()]
    reasons = {Path(line["name"]).name: line["reason"] for line in lines}
    assert reasons == {s.name: REASONS[s.fault] for s in twenty.scenes if s.fault}
    assert metrics["left_out"] == Counter(reasons.values())
    assert metrics["recordings"] == 20 and metrics["annotated"] == 13
    assert metrics["dropped"]["low confidence"] >= 2 * 13 and metrics["dropped"]["detected twice"]


def test_killed_and_resumed_ends_the_same(
    twenty: Set, annotated: tuple, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models, caption = twenty.models(), KnownBoxes.caption

    def killed(self: KnownBoxes, image: np.ndarray, prompt: str) -> str:
        if self.captioned == 12:
            raise KeyboardInterrupt
        return caption(self, image, prompt)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(KnownBoxes, "caption", killed)
        twenty.annotate(tmp_path, models, first=8)
    lines = tmp_path / "annotations.jsonl"
    done = lines.read_bytes()
    with lines.open("ab") as file:
        file.write(b'{"name": "rec')  # the kill came in the middle of a line
    again = twenty.models()
    metrics = twenty.annotate(tmp_path, again, first=8)
    whole = lines.read_bytes()
    assert (annotated[0] / "annotations.jsonl").read_bytes().startswith(whole)
    assert metrics["recordings"] == 8
    assert 0 < done.count(b"\n") < whole.count(b"\n") == metrics["annotated"]
    there = sum(len(json.loads(line)["instances"]) for line in done.splitlines())
    assert again.captioned == metrics["instances"] - there
    third = twenty.models()
    assert twenty.annotate(tmp_path, third, first=8) == metrics and not third.detected
    monkeypatch.setattr(third, "names", {"detector": "another"})
    with pytest.raises(UserError, match="other models or settings"):
        twenty.annotate(tmp_path, third)


def test_lists_of_both_directions(tmp_path: Path) -> None:
    def paths(kind: str, *frames: int) -> list[str]:
        return [f"data/data_seen/images/{kind}/0/rec_00000/frame{i}.jpg" for i in frames]

    lines = []
    for i in (10, 9):
        reference, image, *window = paths("vision", 0, i, i - 2, i - 1, i + 1, i + 2)
        lines.append([reference, *paths("touch", 0), image, *paths("touch", i), *window])
    list_ = tmp_path / "list.txt"
    list_.write_text("\n".join(map(" ".join, lines)) + "\n\n")
    recording = read_visgel_list(list_)[0]
    assert recording.name == "data/data_seen/images/touch/0/rec_00000"
    assert recording.steps == tuple((line[2], line[3]) for line in lines[::-1])  # 9 before 10
    assert list(recording.video) == paths("vision", 7, 8, 9, 10, 11, 12)
    swapped = [[x[1], x[0], x[3], x[2], *paths("touch", 1, 2, 3, 4)] for x in lines]
    list_.write_text("\n".join(map(" ".join, swapped)))
    other = read_visgel_list(list_)[0]
    assert (other.reference, other.steps) == (recording.reference, recording.steps)
    list_.write_text(" ".join(lines[0]) + "\nonly two\n")
    with pytest.raises(UserError, match=r"list.txt:2 has 2 paths, not 8"):
        read_visgel_list(list_)


@pytest.mark.slow
def test_annotations_become_touches_that_align_trains_on(annotated: tuple, tmp_path: Path) -> None:
    lines = annotated[0] / "annotations.jsonl"
    records = read_annotations(lines)
    touches = annotated_touches(records, "gelsight_markers")
    assert touches.frames.shape == (13, 240, 320, 3) and touches.view.shape == (13, 224, 224, 3)
    assert set(touches.object) == touches.descriptions.keys() == {r.object for r in records}
    assert touches.descriptions == {name: [name] for name in touches.object}
    assert (touches.frames[3] != touches.background[touches.background_index[3]]).any()
    text = lines.read_text().splitlines()
    for name, part in (("a.jsonl", text[:7]), ("b.jsonl", text[7:])):
        (tmp_path / name).write_text("\n".join(part))
    a, b = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    assert [len(t) for t in open_annotations(a, b, "gelsight_markers")] == [7, 6]
    with pytest.raises(UserError, match="share 7 recordings"):
        open_annotations(a, lines, "gelsight_markers")
    sizes = "--sensor gelsight_markers --align.backbone vit-tiny --align.epochs 1".split()
    data = ["--data", str(a), "--validation", str(b), "--out", str(tmp_path / "run")]
    main(["train-encoder", "align", *data, *sizes])
    assert (tmp_path / "run" / "encoder").is_dir()


def test_the_real_classes(twenty: Set, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Random weights: the detector finds boxes anywhere, the captioner answers anything."""
    pytest.importorskip("transformers")
    detector = str(make_detector(tmp_path / "detector"))
    captioner = str(make_captioner(tmp_path / "captioner"))
    with pytest.raises(SystemExit, match="no grounding-dino"):
        main(["annotate", str(twenty.list), "--detector", captioner, "--out", str(tmp_path / "no")])
    list_ = tmp_path / "list.txt"
    list_.write_text("\n".join(sorted(twenty.list.read_text().splitlines())[:16]))  # 2 recordings
    options = ["--root", str(twenty.root), "--detector", detector, "--captioner", captioner]
    options += ["--min-score", "0", "--min-overlap", "0", "--out", str(tmp_path / "out")]
    main(["annotate", str(list_), *options, "--sensor-box", "7", "7", "33", "33"])
    printed = capsys.readouterr().out
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["recordings"] == 2 and f"{metrics['annotated']} of 2 recordings" in printed
    for record in by_recording(tmp_path / "out").values():
        assert record.provenance["detector"] == detector and "CSRT" in record.provenance["tracker"]
        assert all("What specific" not in i.caption for i in record.instances)
    for reason in metrics["left_out"]:
        assert reason in printed

"""Readers of published touch data, and the benchmark that judges encoders by them."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from benchmarks.published_touch.force_grasps import read_force_grasps
from benchmarks.real_touch import forces, markers, property_probe, slip, touch_spectrum, words
from benchmarks.real_touch.embedders import find_embedder
from benchmarks.real_touch.property_probe import (
    adapted_nearest_is_same,
    nearest_is_same,
    predict_properties,
    sentences_right,
)
from benchmarks.real_touch.videos import Config, run
from touchgoal.encoders.backbones.touch_backbone import BaseTouchEncoder
from touchgoal.encoders.pretrained import load_encoder, load_pooled_encoder
from touchgoal.encoders.towers.towers import OfflineTowers
from touchgoal.encoders.whitening.adapt import centre
from touchgoal.encoders.whitening.text_head import rank_sentences
from touchgoal.episodes.importers.labelled_videos import read_labelled_videos
from touchgoal.episodes.media import write_video
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError

Y, X = np.mgrid[:60, :80].astype(np.float32)


def press(obj: int, frames: int = 9) -> np.ndarray:
    """Three untouched frames, then stripes whose width and colour depend on the object."""
    rng = np.random.default_rng(obj)
    stripes = 60 * np.sin(X / (4 + 2 * obj))[..., None] * [1, 0.5 * obj, -1]
    gel = 100 + rng.normal(0, 1, (frames, 60, 80, 3))
    pressed = np.arange(frames)[:, None, None, None] >= 5
    return (gel + pressed * stripes).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clips")
    (folder / "videos").mkdir()
    with (folder / "labels.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow("file object name split hardness roughness bumpiness".split())
        for obj in range(6):
            for take in range(3):
                name = f"object{obj}_{take}.mp4"
                write_video(folder / "videos" / name, press(obj), 10)
                split = ("val" if obj % 3 == 2 else "train") if obj < 5 else "unlabelled"
                ranks = [obj % 3, obj // 2, 1] if obj < 5 else ["", "", ""]
                rows.writerow([name, f"object{obj}", f"object {obj}", split, *ranks])
    return folder


def test_the_benchmark_judges_encoders(clips: Path) -> None:
    result = run(Config(data=clips, encoders=("pixels", "random:gelsight_mini")))
    row = result["rows"][0]
    assert row["videos"] == 15 and row["objects"] == 5
    assert row["nearest"] == 1.0
    assert row["light"]["light"] > 0
    assert "in 18 clips: 0 alarms within the first three frames; 0 missed" in result["table"]


def test_an_encoder_is_adapted_to_videos(clips: Path, tmp_path: Path) -> None:
    """Adapting shrinks distances between videos of one object relative to other objects."""
    main(["train-encoder", "adapt", "--data", str(clips), "--out", str(tmp_path)])
    adapted = load_encoder(tmp_path / "encoder")
    goals = adapted.embed_text_goal(["a soft object", "a slightly hard object"], OfflineTowers())
    touches = [adapted.embed(press(obj))[5:].mean(0) for obj in (0, 1)]
    assert (goals @ np.stack(touches, 1)).argmax(1).tolist() == [0, 1]
    videos = [v for v in read_labelled_videos(clips) if v.object in ("object0", "object1")]
    names = np.array([v.object for v in videos])

    def apart(encoder: BaseTouchEncoder) -> float:
        """Squared distances within objects, as a share of those between them."""
        seen = np.stack([encoder.embed(v.frames())[5:].mean(0) for v in videos])
        means = np.stack([seen[names == name].mean(0) for name in ("object0", "object1")])
        within = np.square(seen - means[(names == "object1").astype(int)]).sum(1).mean()
        return float(within / np.square(means[0] - means[1]).sum())

    assert apart(adapted) < 0.7 * apart(load_encoder("gelsight_mini"))


def test_the_spectrum_of_touches(tmp_path: Path) -> None:
    """A wave's power is in its own band; waves pressed on a DIGIT and simulated presses are read."""
    for i, band in enumerate(touch_spectrum.BANDS):  # 4.62: where a difference of Gaussians peaks
        wave = np.repeat(np.sin(2 * np.pi * np.arange(400) / (4.62 * band))[None, :, None], 200, 0)
        change = np.repeat(wave, 3, 2).astype(np.float32)
        middle = np.zeros((200, 400), bool)
        middle[60:140, 80:320] = True
        assert touch_spectrum.band_powers(change, middle).argmax() == i
    rng = np.random.default_rng(0)
    for thing in range(4):
        for take in range(3):
            image = 100 + rng.normal(0, 1, (320, 240, 3))
            top, left = rng.integers(10, 150, 2)
            image[top : top + 60, left : left + 60] += 40 * np.sin(np.arange(60) / 3)[:, None]
            path = tmp_path / f"touch/thing{thing}/{take}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path.with_suffix(".jpg")), image)
    real = touch_spectrum.read_digit(tmp_path)
    assert len(real.of(tuned=True).powers) == len(real.of(tuned=False).powers) == 6
    assert (real.powers.argmax(1) == 2).all()
    made = touch_spectrum.simulated_touches("digit", surfaces=3, seed=0)
    assert len(made.powers) and (made.powers.argmax(1) >= 2).all()  # that unit is out of focus


def test_words_stay_right_where_all_touches_lie_to_one_side() -> None:
    """Touches exactly towards three sentences, and an offset that makes all of them rough."""
    encoder, towers = load_pooled_encoder("gelsight_mini"), OfflineTowers()
    goals = encoder.embed_text_goal(rank_sentences(1), towers)
    shift = 3 * goals[2] - 0.5 * goals.sum(0)
    features = (goals + shift) @ np.linalg.inv(encoder.whitening.numpy()) + encoder.mean.numpy()
    touches = [torch.from_numpy(row[None]) for row in features]
    assert words.name_ranks(encoder, towers, touches)[:, 1].tolist() == [2, 2, 2]
    centred = centre(encoder, touches, np.arange(3))
    assert words.name_ranks(centred, towers, touches)[:, 1].tolist() == [0, 1, 2]


def test_words_are_judged_by_answers(clips: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(words, "_DRAWS", 1)
    result = words.run(words.Config(data=clips))
    assert result["most_frequent"] == pytest.approx([0.4, 0.4, 1.0])
    shipped, _, _ = result["rows"]
    assert [sum(answers) for answers in shipped["answers"]] == [15, 15, 15]
    assert shipped["right"]["bumpiness"] == pytest.approx(shipped["answers"][2][1] / 15)
    assert [row["objects"] for row in result["few"]] == [1, 3]


def test_sentences_are_judged_on_objects_never_seen() -> None:
    """Embeddings that encode the ranks score above 0.9, noise scores at chance."""
    rng, objects = np.random.default_rng(0), np.repeat(np.arange(60), 2)
    ranks = rng.integers(0, 3, (120, 3))[2 * objects]
    embedded = np.eye(3)[ranks].reshape(120, 9) @ rng.normal(size=(9, 30))
    noise, embed_texts = rng.normal(size=(120, 30)), OfflineTowers().embed_texts
    assert sentences_right(embedded + 0.3 * noise, ranks, objects, embed_texts).mean() > 0.9
    assert sentences_right(noise, ranks, objects, embed_texts).mean() < 0.5


def test_the_benchmark_takes_a_hugging_face_model(tmp_path: Path) -> None:
    """A tiny one with random weights, through the loading code of the real ones."""
    transformers = pytest.importorskip("transformers")
    sizes = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    config = transformers.ViTConfig(**sizes, intermediate_size=16, image_size=32, patch_size=16)
    transformers.ViTModel(config).save_pretrained(tmp_path)
    size = {"height": 32, "width": 32}
    transformers.ViTImageProcessorPil(size=size).save_pretrained(tmp_path)
    frames = press(1)
    assert find_embedder(str(tmp_path), 0)(frames[-2:], frames[0]).shape == (2, 16)


def test_forces_come_with_their_frames(tmp_path: Path) -> None:
    """Objects grasped once have forces and no cost: no other grasp's end could be the goal."""
    table = ["trial,object", *(f"grasp_{obj},object_{obj}" for obj in range(3))]
    (tmp_path / "grasps.csv").write_text("name,object\nball,ball\n")
    with pytest.raises(UserError, match="lacks the column trial"):
        read_force_grasps(tmp_path)
    (tmp_path / "grasps.csv").write_text("\n".join(table))
    for obj in range(3):
        write_video(tmp_path / f"grasp_{obj}.avi", press(obj, 40), 25)
        if obj == 0:
            with pytest.raises(UserError, match=r"names .*grasp_0\.csv"):
                read_force_grasps(tmp_path)
        rows = [f"{0.5 * max(i - 5, 0)},0.04" for i in range(40)]
        text = "\n".join(["force_newtons,gripper_width_m", *rows])
        (tmp_path / f"grasp_{obj}.csv").write_text(text)
    first = read_force_grasps(tmp_path)[0]
    assert first.object == "object_0" and first.force[8] == 1.5
    assert first.frames().shape == (40, 60, 80, 3)
    corners = ((8, 6), (70, 10), (10, 55), (68, 50))
    assert read_force_grasps(tmp_path, corners)[0].frames().shape == (40, 240, 320, 3)
    result = forces.run(forces.Config(data=tmp_path, encoders=("pixels",)))
    assert result["cost"] == {} and result["objects"] == 3


def test_properties_of_unseen_objects_are_predicted() -> None:
    rng = np.random.default_rng(0)
    objects = np.repeat(np.arange(30), 4)
    ranks = np.stack([objects % 3, (objects // 3) % 3], 1)
    embeddings = np.eye(3)[ranks].reshape(120, 6) + 0.2 * rng.normal(size=(120, 6))
    predicted = predict_properties(embeddings, ranks, objects)
    assert (predicted.ranks == ranks).mean() > 0.95
    shuffled = predict_properties(rng.normal(size=(120, 6)), ranks, objects)
    assert (shuffled.ranks == ranks).mean() < 0.45  # chance, for no strength is chosen on them


def test_videos_of_other_objects_tell_what_differs_without_meaning() -> None:
    """Thirty objects by 38 numbers, beside two that are larger and differ from video to video."""
    rng = np.random.default_rng(0)
    objects = np.repeat(np.arange(30), 4)
    kind = rng.normal(size=(30, 38))[objects]
    embeddings = np.hstack([kind, rng.normal(5, 10, (120, 2))])
    assert nearest_is_same(embeddings, objects).mean() < 0.6
    assert adapted_nearest_is_same(embeddings, objects).mean() > 0.9
    shuffled = rng.permutation(objects)  # no object to learn: no better than chance
    assert adapted_nearest_is_same(embeddings, shuffled).mean() < 0.15


def dotted_image(shift: float) -> np.ndarray:
    """6 x 4 dots, 40 px apart and moved to the right; a dot of each row further."""
    image = np.full((200, 280), 160, np.uint8)
    for row in range(4):
        for column in range(6):
            centre = (40 * column + 40 + shift * (2 if column == 2 else 1), 40 * row + 40)
            cv2.circle(image, [round(16 * c) for c in centre], 16 * 9, 20, -1, cv2.LINE_AA, 4)
    return cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.COLOR_GRAY2BGR)


def test_markers_are_compared_with_another_trackers(tmp_path: Path) -> None:
    y, x = np.mgrid[40:200:40, 40:280:40].astype(float)
    for i, shift in enumerate((0.0, 4.0, -3.0, 5.5)):
        cv2.imwrite(str(tmp_path / f"gel_{i}.png"), dotted_image(shift))
        tracked = x + shift + 0.5  # where its first pixel lies is its own affair
        tracked[:, 2] += shift
        if i == 3:
            tracked[0, 0] += 5  # here the other one is wrong
        tables = [x, y, tracked, y + 0.5, np.arange(24).reshape(4, 6)]
        (tmp_path / f"gel_{i}.json").write_text(json.dumps([t.tolist() for t in tables]))
    result = markers.run(markers.Config(data=tmp_path))
    assert result["dots"] == 3 * 24 and result["exchanged"] == result["lost"] == 0
    assert result["near"] == pytest.approx(71 / 72)
    assert result["most_px"] == pytest.approx(5, abs=0.2)
    assert result["moved_px"] == pytest.approx(11) and result["apart_px"] == pytest.approx(40)
    (tmp_path / "gel_2.json").write_text("[1, 2]")
    with pytest.raises(UserError, match=r"gel_2.json does not hold 5 tables"):
        markers.run(markers.Config(data=tmp_path))


def test_slip_is_told_by_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Dots that creep against dots at rest; the shorter recordings help nothing."""
    monkeypatch.setattr(property_probe, "_BOOTSTRAPS", 20)
    lines = ["object,slip,frames_kept,finger_0,finger_2"]
    for slips, frames in ((1, 50), (0, 60)):
        clip = [dotted_image(0.1 * slips * i) for i in range(frames)]
        write_video(tmp_path / f"{slips}.mp4", np.stack(clip), 25)
        lines += [f"thing{i},{slips},{frames},{slips}.mp4,{slips}.mp4" for i in range(3)]
    (tmp_path / "grasps.csv").write_text("\n".join(lines))
    rows = slip.run(slip.Config(data=tmp_path, encoders=()))["rows"]
    found = {row["features"]: row["object"][0] for row in rows}
    assert found["markers"] == 1.0 and found["control: frame of the end"] == 0.5

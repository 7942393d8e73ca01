"""MMWand's tables: splits that hold out what they say, retrieval with a known answer, words for a frozen encoder."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from in_process import in_process_workers

from touchgoal.benchmarks.papers.mmwand.embedded_set import EmbeddedSet
from touchgoal.benchmarks.papers.mmwand.retrieval import PUBLISHED, judge
from touchgoal.control import features as ft
from touchgoal.encoders.alignment.splits import SPLITS, Fold, split_touches
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.encoders.whitening.surface_words import surface_ranks
from touchgoal.episodes import wand_recording
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.episodes.wand_recording import record_touches
from touchgoal.launch.__main__ import main
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, Surface

OBJECTS, TOUCHES = 10, 200


def press_objects(root: Path, sensor: str, seed: int) -> Path:
    with pytest.MonkeyPatch.context() as patch, in_process_workers():
        patch.setattr(wand_recording, "TOUCHES_A_VISIT", 3)
        record_touches(root, sensor, seed, 18, 1)
    return root


@pytest.fixture(scope="module")
def wand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return press_objects(tmp_path_factory.mktemp("wand") / "episodes", "gelsight_mini", 0)


def made_up(seed: int = 0) -> EmbeddedSet:
    """Each object has a direction of its own in every modality, beside noise."""
    rng = np.random.default_rng(seed)
    label, owner = np.arange(TOUCHES) % OBJECTS, np.repeat(np.arange(OBJECTS), 4)

    def embeddings(of: np.ndarray, width: int) -> np.ndarray:
        places = rng.normal(size=(OBJECTS, width))
        return (places[of] + 0.3 * rng.normal(size=(len(of), width))).astype(np.float32)

    return EmbeddedSet(
        names=tuple("abcdefghij"),
        sensor="gelsight_mini",
        label=label,
        visit=np.arange(TOUCHES) // 5,
        sentences=tuple(map(str, range(len(owner)))),
        describes=owner == np.arange(OBJECTS)[:, None],
        texts=embeddings(owner, 24),
        image=embeddings(label, 32)[:, None],
        touch={"touch": embeddings(label, 16)},
        pixels=embeddings(label, 8),
    )


@pytest.mark.parametrize("split", SPLITS)
def test_a_split_holds_out_what_it_says(split) -> None:
    data = made_up()
    drawn = data.label, data.visit, data.describes, 1
    fold, again = split_touches(split, *drawn), split_touches(split, *drawn)
    assert not set(fold.train) & set(fold.test) and (fold.test == again.test).all()
    assert 0.1 < len(fold.test) / TOUCHES < 0.3
    if split == "object":
        assert not set(data.label[fold.train]) & set(data.label[fold.test])
    if split == "press":
        assert not set(data.visit[fold.train]) & set(data.visit[fold.test])
    if split in ("object", "sentence"):
        assert not (fold.train_text & fold.test_text).any()
    if split == "sentence":
        assert (data.describes[:, fold.test_text].sum(1) == 1).all()


def test_retrieval_knows_the_right_answer_and_chance() -> None:
    data = made_up()
    every = Fold(np.arange(0), np.arange(TOUCHES), np.ones(40, bool), np.ones(40, bool))
    one_hot = np.eye(OBJECTS)
    known = {"touch": one_hot[data.label], "image": one_hot[data.label]}
    known["text"] = one_hot[data.describes.argmax(0)]
    blind = {name: np.zeros_like(rows) for name, rows in known.items()}
    assert judge(data, every, known).keys() == PUBLISHED.keys()
    for _, precision in judge(data, every, known).values():
        assert precision.mean() == pytest.approx(1)
    for direction, (_, precision) in judge(data, every, blind).items():
        assert 0.1 < precision.mean() < 0.19, direction


def test_a_surface_is_called_what_it_is() -> None:
    x = np.linspace(0, 2 * np.pi, TILE, endpoint=False, dtype=np.float32)
    fine, coarse = np.sin(64 * x), np.sin(6 * x)

    def ranks(texture: np.ndarray) -> tuple[int, int]:
        tile = np.broadcast_to(texture, (TILE, TILE)).astype(np.float32)
        return surface_ranks(Surface("flat", 1.0, 1.0, tile, 1.0))

    assert ranks(0 * fine) == (0, 0)
    assert ranks(40e-6 * fine)[0] == 2 and ranks(40e-6 * fine)[1] == 0
    assert ranks(200e-6 * coarse) == (0, 2)


def grasps(root: Path) -> Path:
    """Two objects that press a stripe along and across the gel; the second finger is not recorded."""
    rng = np.random.default_rng(0)
    for name, stripe in (("pipe", np.s_[100:140, :]), ("rail", np.s_[:, 140:180])):
        gel = rng.integers(90, 110, (240, 320, 3), dtype=np.uint8)
        frames = np.repeat(gel[None], 12, axis=0)
        frames[6:, *stripe] = 200
        contact = np.repeat(np.arange(12)[:, None] >= 6, 2, axis=1)
        meta = {"object": name, "descriptions": [f"a {name}"], "sensor": "gelsight_mini"}
        observed = {ft.TACTILE_LEFT: frames, ft.TRUTH_CONTACT: contact}
        EpisodeWriter(root).append(Episode(observed, "grasp", meta))
    return root


def test_words_are_added_to_an_encoder_that_stays_as_it_is(
    wand: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grasped = grasps(tmp_path / "grasps")
    command = f"train-encoder words --data {wand} {grasped} --out {tmp_path / 'run'} --surfaces 6"
    command += " --heads.epochs 100 --backgrounds generated"
    assert main(command.split()) in (0, None)
    worded, plain = load_encoder(tmp_path / "run/encoder"), load_encoder("gelsight_mini")
    picture = np.random.default_rng(0).integers(0, 255, (2, 240, 320, 3), dtype=np.uint8)
    np.testing.assert_allclose(worded.embed(picture), plain.embed(picture), atol=2e-3)
    assert worded.towers == "offline" and isinstance(worded, PooledEncoder)
    words = worded.embed_text_goal(["a hard object", "a soft object"], load_towers("offline"))
    images = worded.project_image(torch.rand(3, worded.config.image_dim)).numpy()
    np.testing.assert_allclose(np.linalg.norm([*words, *images], axis=1), 1, atol=1e-4)
    command = f"benchmark zero-shot --data {grasped} --encoders {tmp_path / 'run/encoder'}"
    assert main([*command.split(), "--out", str(tmp_path / "judged")]) in (0, None)
    assert "12 touches of 2 objects" in capsys.readouterr().out
    [row] = json.loads((tmp_path / "judged/metrics.json").read_text())["rows"]
    assert row["2"][0] == 100


@pytest.mark.parametrize("name", ["retrieval", "classification"])
def test_the_benchmarks_run(
    name: str, wand: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"benchmark {name} --data {wand} --cache {wand.parent / 'cache'}"
    command += f" --out {tmp_path / 'run'} --encoders gelsight_mini --seeds 1"
    if name == "retrieval":
        command += " --heads.epochs 2 --trained efficientnet --epochs 1"
    assert main([*command.split(), "--splits", "sample", "press"]) in (0, None)
    printed = capsys.readouterr().out
    assert "published" in printed and "raw pixels" in printed and "gelsight_mini" in printed
    rows = json.loads((tmp_path / "run/metrics.json").read_text())["rows"]
    assert {row["split"] for row in rows} == {"sample", "press"}
    if name == "retrieval":
        assert {"efficientnet trained", "efficientnet trained, without touch-text"} <= {
            row["row"] for row in rows
        }


def test_touches_of_another_sensor_choose_among_sentences(
    wand: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = press_objects(tmp_path / "episodes", "gelsight", 1)
    command = f"benchmark zero-shot --data {other} --other {wand} --seeds 3 --heads.epochs 2"
    command += f" --cache {wand.parent / 'cache'} --out {tmp_path / 'run'}"
    assert main(command.split()) in (0, None)
    assert "trained on gelsight_mini" in capsys.readouterr().out
    row = json.loads((tmp_path / "run/metrics.json").read_text())["rows"][0]
    assert row["seen top-1"][0] <= row["seen top-5"][0]

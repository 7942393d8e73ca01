"""MMWand's tables on simulated and published touch: splits that hold out what they say, known answers."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from in_process import in_process_workers, run_benchmark

from benchmarks.papers.mmwand.real import zero_shot
from benchmarks.papers.mmwand.splits import SPLITS, split_touches
from benchmarks.published_touch.objectfolder_real import read_objectfolder_real, read_touches
from benchmarks.published_touch.tvl import read_tvl
from touchgoal.control import features as ft
from touchgoal.encoders.alignment.described_touches import surface_ranks
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.episodes.wand import recording as wand_recording
from touchgoal.episodes.wand.recording import record_touches
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, Surface


@pytest.fixture(scope="module")
def wand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("wand") / "episodes"
    with pytest.MonkeyPatch.context() as patch, in_process_workers():
        patch.setattr(wand_recording, "TOUCHES_A_VISIT", 3)
        record_touches(root, "gelsight_mini", 0, 18, 1)
    return root


@pytest.mark.parametrize("split", SPLITS)
def test_a_split_holds_out_what_it_says(split) -> None:
    label, visit = np.arange(200) % 10, np.arange(200) // 5
    describes = np.repeat(np.arange(10), 4) == np.arange(10)[:, None]
    fold, again = (split_touches(split, label, visit, describes, 1) for _ in range(2))
    assert not set(fold.train) & set(fold.test) and (fold.test == again.test).all()
    assert 0.1 < len(fold.test) / 200 < 0.3
    if split == "object":
        assert not set(label[fold.train]) & set(label[fold.test])
    if split == "press":
        assert not set(visit[fold.train]) & set(visit[fold.test])
    if split in ("object", "sentence"):
        assert not (fold.train_text & fold.test_text).any()
    if split == "sentence":
        assert (describes[:, fold.test_text].sum(1) == 1).all()


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
    image = np.random.default_rng(0).integers(0, 255, (2, 240, 320, 3), dtype=np.uint8)
    np.testing.assert_allclose(worded.embed(image), plain.embed(image), atol=2e-3)
    assert worded.towers == "offline" and isinstance(worded, PooledEncoder)
    words = worded.embed_text_goal(["a hard object", "a soft object"], load_towers("offline"))
    images = worded.project_image(torch.rand(3, worded.config.image_dim)).numpy()
    np.testing.assert_allclose(np.linalg.norm([*words, *images], axis=1), 1, atol=1e-4)
    command = f"zero-shot --data {grasped} --encoders {tmp_path / 'run/encoder'}"
    run_benchmark(*command.split(), "--out", tmp_path / "judged")
    assert "12 touches of 2 objects" in capsys.readouterr().out
    [row] = json.loads((tmp_path / "judged/metrics.json").read_text())["rows"]
    assert row["2"][0] == 100


@pytest.mark.parametrize("name", ["retrieval", "classification"])
def test_the_benchmarks_run(
    name: str, wand: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"{name} --data {wand} --cache {wand.parent / 'cache'}"
    command += f" --out {tmp_path / 'run'} --encoders gelsight_mini --seeds 1"
    command += " --trained efficientnet"
    command += " --heads.epochs 2 --epochs 1" if name == "retrieval" else " --trained-epochs 1"
    run_benchmark(*command.split(), "--splits", "sample", "press")
    printed = capsys.readouterr().out
    assert "published" in printed and "raw pixels" in printed and "gelsight_mini" in printed
    rows = json.loads((tmp_path / "run/metrics.json").read_text())["rows"]
    assert {row["split"] for row in rows} == {"sample", "press"}
    named = {row.get("row", row.get("input")) for row in rows}
    assert "efficientnet trained" in named
    assert (name == "retrieval") == ("efficientnet trained, without touch-text" in named)


def write_table(path: Path, *rows: tuple[object, ...]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image.astype(np.uint8))


def test_objectfolder_real(tmp_path: Path) -> None:
    rows: list[tuple[object, ...]] = [("index", "name", "material")]
    materials = ("Steel", "Wood", "Steel", "")
    for i, material in enumerate(materials, 1):
        image = np.full((320, 240, 3), 100.0)
        image[:10, :, 2] = 40 * i  # red at the top
        write_image(tmp_path / "touch" / f"{i:03d}.png", image)
        rows.append((i, f"object_{i}", material))
    write_table(tmp_path / "objects.csv", *rows)
    write_image(tmp_path / "picture" / "002.jpg", np.zeros((8, 8, 3)))
    objects = read_objectfolder_real(tmp_path)
    assert [item.material for item in objects] == ["steel", "wood", "steel", None]
    assert [item.image is not None for item in objects] == [False, True, False, False]
    touches, untouched = read_touches(objects)
    assert touches.shape == (4, 240, 320, 3) and touches[3, 0, 0, 0] == 160  # RGB, turned left
    assert untouched[0, 0, 0] == 100
    result = zero_shot.run(zero_shot.Config(data=tmp_path))
    assert "the most frequent material" in result["table"] and "0.67" in result["table"]


def test_tvl(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng, ssvtp, hct = np.random.default_rng(0), tmp_path / "ssvtp", tmp_path / "hct" / "data1"
    felt, rows, header = (
        ("smooth, hard", "rough, soft"),
        [],
        ("url", "tactile", "background", "caption"),
    )
    for i in range(24):
        touched = np.full((24, 32, 3), 120.0) + rng.normal(0, 5, (24, 32, 3))
        touched[:, : 16 if i % 2 else 4] += 60
        if i < 8:
            write_image(ssvtp / f"images_rgb/image_{i}_rgb.jpg", touched)
            write_image(ssvtp / f"images_tac/image_{i}_tac.jpg", touched)
            (ssvtp / "text").mkdir(exist_ok=True)
            (ssvtp / "text" / f"labels_{i}.txt").write_text(felt[i % 2].capitalize() + ".\n")
            continue
        own = (f"vision/{i // 2}/{i}.jpg", f"tactile/{i // 2}/{i}.jpg", f"tactile/{i // 2}/bg.jpg")
        rows.append((*own, felt[i % 2]))
        for name in own[:2]:
            write_image(hct / name, touched)
    urls = [(f"images_rgb/image_{i}_rgb.jpg",) for i in range(8)]
    write_table(ssvtp / "train.csv", ("url",), *urls[:6])
    write_table(ssvtp / "test.csv", ("url",), *urls[6:])
    write_table(hct / "train.csv", header, *rows)
    (hct / "contact.json").write_text(json.dumps({}))
    write_image(hct / "digit_background.png", np.full((24, 32, 3), 120.0))
    touches = read_tvl(tmp_path)
    assert len(touches) == 24 and touches[0].words == ("smooth", "hard")
    assert touches[0].untouched is None and touches[0].press == "ssvtp/0"
    assert touches[6].press == "hct/data1/tactile/4"  # a frame before another of the same press
    assert touches[6].untouched == hct / "digit_background.png"  # where a press has none of its own
    command = f"retrieval --data {tmp_path} --cache {tmp_path / 'cache'} --encoders pixels"
    command += f" --seeds 1 --heads.epochs 20 --out {tmp_path / 'run'}"
    run_benchmark(*command.split())
    assert "of 2 objects" in capsys.readouterr().out
    judged = json.loads((tmp_path / "run/metrics.json").read_text())["rows"]
    found = {r["row"]: r for r in judged if r["split"] == "press"}
    assert found["raw pixels"]["touch to text"][0] == 100 > found["chance"]["touch to text"][0]
    assert found["pixels"]["image to text"][0] == 100
    (hct / rows[0][0]).unlink()
    with pytest.raises(UserError, match="not there"):
        read_tvl(tmp_path)

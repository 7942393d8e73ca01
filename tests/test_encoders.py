"""Preprocessor, ViT, InfoNCE, touch encoder and its files."""

import json
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from toy_towers import PaintTowers

from touchgoal.control.tactile.light_gain import remove_gain
from touchgoal.encoders import pretrained
from touchgoal.encoders.alignment.infonce import info_nce, symmetric_info_nce
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.vit import PRESETS
from touchgoal.encoders.preprocess import SCALE, check_images, preprocessor_for
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import portable

ROOT = Path(__file__).parents[1]
MINI = preprocessor_for("gelsight_mini")


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


def make_encoder() -> TouchEncoder:
    config = TouchEncoderConfig.for_towers(PRESETS["tiny"], PaintTowers(), "gelsight_mini", 16)
    return TouchEncoder(config).eval()


def test_untouched_is_zero_and_change_is_in_units_of_the_scale() -> None:
    rng = np.random.default_rng(0)
    background = rng.integers(50, 200, (240, 320, 3)).astype(np.uint8)
    pressed = background.copy()
    pressed[:80, :, 1] += 16
    out = MINI(np.stack([background, pressed]), background)
    assert out.shape == (2, 3, 120, 160)
    np.testing.assert_array_equal(out[0], 0)
    expected = np.zeros((3, 120, 160))
    expected[1, :40] = 16 / SCALE
    np.testing.assert_allclose(out[1], expected, atol=1e-6)


def test_pixels_are_averaged_over_their_area() -> None:
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, (1, 240, 320, 3)).astype(np.uint8)
    background = np.full((240, 320, 3), 100, np.uint8)
    out = MINI(frame, background)
    steady = remove_gain(frame[0], background)
    blocks = steady.reshape(120, 2, 160, 2, 3).mean((1, 3)).transpose(2, 0, 1)
    np.testing.assert_allclose(out[0] * SCALE + 100, blocks, atol=1e-3)


def unit(n: int, d: int) -> torch.Tensor:
    return F.normalize(torch.randn(n, d), dim=1)


def test_info_nce_is_equation_1() -> None:
    a, b = unit(5, 7), unit(5, 7)
    expected = 0.0
    for i in range(5):
        scores = [math.exp(float(a[i] @ b[j]) / 0.2) for j in range(5)]
        expected -= math.log(scores[i] / sum(scores)) / 5
    assert info_nce(a, b, 0.2).item() == pytest.approx(expected, rel=1e-5)
    back = info_nce(b, a, 0.2).item()
    assert symmetric_info_nce(a, b, 0.2).item() == pytest.approx((expected + back) / 2, rel=1e-5)


def test_multi_positive_is_the_mean_over_right_answers() -> None:
    a, b = unit(4, 6), unit(4, 6)
    eye = torch.eye(4, dtype=torch.bool)
    torch.testing.assert_close(info_nce(a, b, 0.1, eye), info_nce(a, b, 0.1))
    positives = eye.clone()
    positives[0, 2] = True
    log_p = (a @ b.T / 0.1).log_softmax(1)
    rows = [(log_p[0, 0] + log_p[0, 2]) / 2, log_p[1, 1], log_p[2, 2], log_p[3, 3]]
    torch.testing.assert_close(info_nce(a, b, 0.1, positives), -torch.stack(rows).mean())
    both = (info_nce(a, b, 0.1, positives) + info_nce(b, a, 0.1, positives.T)) / 2
    torch.testing.assert_close(symmetric_info_nce(a, b, 0.1, positives), both)


def test_saved_encoder_is_the_same(tmp_path: Path) -> None:
    encoder = make_encoder()
    touch = torch.randn(8, 3, 120, 160)
    pretrained.save(encoder, tmp_path / "full", {"seed": 3}, half=False)
    full = pretrained.load_encoder(tmp_path / "full", "gelsight_mini")
    assert torch.equal(full.embed_touch(touch), encoder.embed_touch(touch))
    assert full.config == encoder.config and not full.training
    assert pretrained.ENCODER_FORMAT.provenance(tmp_path / "full") == {"seed": 3}
    with pytest.raises(UserError, match="is for gelsight_mini, not digit"):
        pretrained.load_encoder(tmp_path / "full", sensor="digit")

    pretrained.save(encoder, tmp_path / "half", {})
    half = pretrained.load_encoder(tmp_path / "half")
    cosine = (half.embed_touch(touch) * encoder.embed_touch(touch)).sum(1)
    assert (1 - cosine).max() < 1e-3


def edit_json(directory: Path, change: Callable[[dict], object]) -> None:
    path = directory / "encoder.json"
    description = json.loads(path.read_text())
    change(description)
    path.write_text(json.dumps(description))


def wrong_weights(directory: Path) -> None:
    weights = load_file(directory / "encoder.safetensors")
    weights["touch_head.weight"] = torch.zeros(16, 31)
    del weights["text_head.weight"]
    save_file(weights, directory / "encoder.safetensors")


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no json": (lambda d: (d / "encoder.json").unlink(), "no touch encoder.*train-encoder"),
    "no weights": (lambda d: (d / "encoder.safetensors").unlink(), "missing"),
    "old preprocessor": (
        lambda d: edit_json(d, lambda j: j["config"].update(preprocessor="gelsight_mini/v0")),
        "gelsight_mini/v0, this version has gelsight_mini/v1",
    ),
    "another field": (
        lambda d: edit_json(d, lambda j: j["config"]["vit"].update(layers=3)),
        r"damaged \(vit.layers: Unexpected keyword",
    ),
    "future format": (lambda d: edit_json(d, lambda j: j.update(format=99)), "format 99"),
    "wrong weights": (
        wrong_weights,
        r"text_head.weight is None|touch_head.weight is \(16, 31\), not \(16, 32\)",
    ),
    "cut short": (lambda d: os.truncate(d / "encoder.safetensors", 1000), "damaged"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_refused(tmp_path: Path, damage: str) -> None:
    pretrained.save(make_encoder(), tmp_path, {})
    spoil, message = DAMAGES[damage]
    spoil(tmp_path)
    with pytest.raises(UserError, match=message) as error:
        pretrained.load_encoder(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda x: x / 255, r"not of float64: values of 0 to 1 become"),
        (lambda x: np.moveaxis(x, -1, -3), "put the colours last"),
        (lambda x: x[:, :, :120], "1.33 times as wide as high"),
        (lambda x: x[0], "one image needs its background"),
    ],
)
def test_embed_refuses_what_is_no_image(wrong: Callable, message: str) -> None:
    images = np.zeros((3, 240, 320, 3), np.uint8)
    with pytest.raises(UserError, match=message) as error:
        make_encoder().embed(wrong(images))
    assert "\n" not in str(error.value)
    with pytest.raises(UserError, match=r"not a torch.Tensor: tensor.cpu\(\).numpy\(\)"):
        check_images("images", torch.from_numpy(images), ndim=(3, 4))


def test_embed_takes_one_image_or_many() -> None:
    encoder = make_encoder()
    images = np.random.default_rng(0).integers(0, 256, (3, 240, 320, 3), dtype=np.uint8)
    many = encoder.embed(images)
    assert many == pytest.approx(encoder.embed_frames(images, images[0]))
    one = encoder.embed(images[1], background=images[0])
    assert one.shape == many[1].shape and one == pytest.approx(many[1], abs=1e-5)


def test_encoders_are_found_by_name_or_path() -> None:
    shipped = pretrained.load_encoder("gelsight_mini")
    assert shipped.config.sensor == "gelsight_mini"
    assert pretrained.find_encoder("gelsight_mini") == pretrained.DEFAULT_ENCODER
    assert pretrained.find_encoder(pretrained.DEFAULT_ENCODER) == pretrained.DEFAULT_ENCODER
    with pytest.raises(UserError, match="there is no touch encoder 'gelsigt': .*gelsight_mini"):
        pretrained.load_encoder("gelsigt")


def test_no_file_of_weights_names_a_folder_of_this_machine(tmp_path: Path) -> None:
    made_from = {
        "command": f"touchgoal train-encoder mae --data {tmp_path}/a/b --out={Path.cwd()}/runs/x",
        "data": [{"path": str(tmp_path / "set"), "checksum": "a/b"}],
    }
    pretrained.save(make_encoder(), tmp_path, made_from)
    assert pretrained.ENCODER_FORMAT.provenance(tmp_path) == {
        "command": "touchgoal train-encoder mae --data b --out=runs/x",
        "data": [{"path": "set", "checksum": "a/b"}],
    }
    shipped = [p for f in ("encoders", "policies") for p in (ROOT / f / "weights").rglob("*.json")]
    assert len(shipped) > 8
    for path in shipped:
        record = json.loads(path.read_text())
        assert portable(record) == record

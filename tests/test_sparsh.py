"""Sparsh's networks: the published weights, encoders and layouts."""

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from sparsh_files import DEPTH, plain_forward, published
from torch import Tensor

import touchgoal
from touchgoal.encoders.backbones.sparsh import SPARSH_BASE
from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.encoders.pretrained import find_encoder, load_encoder, save
from touchgoal.encoders.published import load_published, load_sparsh
from touchgoal.policies.perception.frozen_touch import load_touch
from touchgoal.runtime.errors import UserError

TOY = ViTConfig((32, 48), width=48, depth=2, heads=2, mlp_ratio=2.0)


@pytest.mark.parametrize(
    ("method", "parameters"),
    [("mae", 86_254_848), ("dino", 86_255_616), ("ijepa", 86_386_944), ("vjepa", 86_537_472)],
)
def test_models_have_the_published_number_of_parameters(method: str, parameters: int) -> None:
    with torch.device("meta"):
        vit = ViT(SPARSH_BASE[method])
    assert sum(parameter.numel() for parameter in vit.parameters()) == parameters


class Scheduler:
    """A pickled object whose class runs code when loaded, as beside a training's weights."""

    def __init__(self, path: Path, function: Any) -> None:
        self.path, self.function = path, function

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, (f"touch {self.path}",)


def save_training(path: Path, weights: dict[str, Tensor], prefix: str, *pickled: Any) -> None:
    model = {prefix + name: weight for name, weight in weights.items()}
    model |= {"online_probes.0.decoder.bias": torch.zeros(3)}
    linear = torch.nn.Linear(2, 2)
    optimizer = torch.optim.AdamW(linear.parameters())
    linear(torch.ones(2)).sum().backward()
    optimizer.step()
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 10)
    state = {"model": model, "optim": optimizer.state_dict(), "scheduler": schedule}
    torch.save(state | {"global_step": 3, "more": list(pickled)}, path)


def test_code_in_a_checkpoint_never_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module, trace = ModuleType("tactile_ssl"), tmp_path / "ran"
    exec("def run(command):\n    import os\n    os.system(command)", module.__dict__)
    monkeypatch.setitem(sys.modules, "tactile_ssl", module)
    weights, path = published(), tmp_path / "mae_vittiny.ckpt"
    for function in (module.run, os.system):
        save_training(path, weights, "encoder.", Scheduler(trace, function))
        assert load_sparsh(path).config.depth == DEPTH
        assert not trace.exists()
    torch.load(path, weights_only=False)
    assert trace.exists(), "the trap is one"


def test_a_wrong_file_is_refused_with_the_keys_that_do_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "encoder.safetensors"
    wrong = published()
    wrong["blocks.1.ls2.beta"] = wrong.pop("blocks.1.ls2.gamma")
    wrong["blocks.0.attn.proj.bias"] = torch.zeros(3)
    save_file(wrong, path)
    with pytest.raises(UserError) as refusal:
        load_sparsh(path)
    for line in ("ls2.gamma is missing", "ls2.beta is unknown", "bias is (3,), not (192,)"):
        assert line in str(refusal.value)
    other = published()
    other["pos_embed.frequency_bands"] *= 2
    save_file(other, path)
    with pytest.raises(UserError, match="frequency_bands are not 10000"):
        load_sparsh(path)
    (tmp_path / "a.ckpt").write_bytes(b"no")
    with pytest.raises(UserError, match="a.ckpt"):
        load_sparsh(tmp_path / "a.ckpt")


UPRIGHT, SQUARE = (320, 240), (224, 224)
SQUARES = {"layer_scale": False, "stored": 196}
CLIPS = {"channels": 3, "tubelet": 2, "layer_scale": False, "stored": 392}
# What the weights are, the names a training gives them, the size of their images, and how many frames
# before the newest each one lies.
METHODS: dict[str, tuple[dict[str, Any], str, tuple[int, int], tuple[int, ...]]] = {
    "mae": ({}, "encoder.", UPRIGHT, (0, 5)),
    "dino": ({"registers": 1}, "teacher_encoder.backbone.", UPRIGHT, (0, 5)),
    "ijepa": (SQUARES, "target_encoder.", SQUARE, (0, 5)),
    "vjepa": (CLIPS, "target_encoder.backbone.", SQUARE, (0, 2, 4, 6)),
}


def video(n: int = 9, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """A ramp of colours that no flip or turn leaves alone, and changes that reach the ends of the scale."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: shape[0], : shape[1]]
    still = np.stack([x % 256, y, (x + y) // 3], 2)
    change = rng.integers(-200, 200, (n, *shape, 3)) * (np.arange(n) > 1)[:, None, None, None]
    return (still + change).clip(0, 255).astype(np.uint8)


def prepared(frame: np.ndarray, background: np.ndarray | None, size: tuple[int, int]) -> np.ndarray:
    """Prepare a frame (3, H, W): background removed, turned clockwise, resized, 0 to 1."""
    if background is not None:
        change = (frame.astype(float) - background.astype(float)) / 255 + 0.5
        frame = (255 * np.clip(change, 0, 1)).astype(np.uint8)
    turned = np.stack([frame[::-1, :, c].T for c in range(3)], 2)  # row r becomes column h - 1 - r
    resized = Image.fromarray(turned).resize((size[1], size[0]), Image.Resampling.BILINEAR)
    return (np.asarray(resized) / 255).transpose(2, 0, 1).astype(np.float32)


def expected(
    weights: dict[str, torch.Tensor], frames: np.ndarray, i: int, method: str, subtract: bool = True
) -> np.ndarray:
    *_, size, offsets = METHODS[method]
    background = frames[0] if subtract else None
    embedded = [prepared(frames[max(i - back, 0)], background, size) for back in offsets]
    touch = np.stack(embedded, 1) if method == "vjepa" else np.concatenate(embedded)
    return plain_forward(weights, torch.from_numpy(touch)).mean(0).numpy()


@pytest.mark.parametrize("method", METHODS)
def test_raw_frames_give_the_published_features(tmp_path: Path, method: str) -> None:
    """From a training's checkpoint; a file of the weights alone gives the same."""
    options, prefix, *_ = METHODS[method]
    weights, frames = published(**options), video()
    path = tmp_path / f"{method}_vittiny.ckpt"
    save_training(path, weights, prefix)
    save_file(weights, bare := path.with_suffix(".safetensors"))
    encoder = touchgoal.load_encoder(path)
    found = encoder.embed(frames)
    np.testing.assert_array_equal(touchgoal.load_encoder(bare).embed(frames[:1]), found[:1])
    for i in (0, 3, 8):
        np.testing.assert_allclose(found[i], expected(weights, frames, i, method), atol=2e-5)
    single = encoder.embed(frames[3], background=frames[0])
    alone = np.stack([frames[0], *[frames[3]] * 8])  # a single image is its own past
    np.testing.assert_allclose(single, expected(weights, alone, 8, method), atol=2e-5)


def test_options_and_a_folder_of_ours(tmp_path: Path) -> None:
    weights, frames = published(), video()
    save_file(weights, tmp_path / "mae_vittiny.safetensors")
    encoder = load_published(tmp_path, stride=1, subtract=False)
    shifted = np.stack([frames[3]] * 4 + [frames[8]])
    wanted = expected(weights, shifted, 4, "mae", subtract=False)
    both = np.stack([frames[3], frames[8]])
    np.testing.assert_allclose(encoder.embed(both)[1], wanted, atol=2e-5)
    with pytest.raises(UserError, match="needs an encoder of ours"):
        find_encoder(tmp_path, published=False)
    save(encoder, tmp_path / "ours", {}, half=False)
    again = load_touch(tmp_path / "ours")
    assert again.reach == 1 and again.sensor is None
    np.testing.assert_array_equal(again.encoder.embed(both), encoder.embed(both))


def test_images_of_any_sensor_become_upright_four_by_three(tmp_path: Path) -> None:
    save_file(published(), tmp_path / "mae_vittiny.safetensors")
    preprocess = load_encoder(tmp_path).preprocess
    lying = video(3, (48, 100))[2:]  # 64 columns about the centre are 4:3
    cut = np.ascontiguousarray(lying[:, :, 18:82])
    assert preprocess(lying, lying[0]).shape == (1, 3, *UPRIGHT)
    np.testing.assert_array_equal(preprocess(lying, lying[0] // 2), preprocess(cut, cut[0] // 2))
    upright = np.ascontiguousarray(np.rot90(cut[0], -1))
    turned = preprocess(upright[None], upright // 2)
    np.testing.assert_array_equal(turned, preprocess(cut, cut[0] // 2))


def test_ids_of_hugging_face(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Uses the client's cache, filled as by a download."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(UserError, match="sparsh-mae-toy is not in") as refusal:
        load_encoder("facebook/sparsh-mae-toy")
    assert "\n" not in str(refusal.value) and "hf download" in str(refusal.value)
    commit = "0" * 40
    folder = tmp_path / "models--facebook--sparsh-mae-toy"
    (folder / "snapshots" / commit).mkdir(parents=True)
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text(commit)
    save_file(published(), folder / "snapshots" / commit / "mae_vittiny.safetensors")
    assert load_encoder("facebook/sparsh-mae-toy").offsets == (0, 5)

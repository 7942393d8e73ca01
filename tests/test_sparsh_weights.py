"""Published checkpoints on our transformer, against a forward pass written from the specification."""

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from touchgoal.control.errors import UserError
from touchgoal.encoders.backbones.sparsh_weights import load_sparsh

WIDTH, HEADS, DEPTH, PATCH = 192, 3, 2, 16


def published(
    channels: int = 6,
    registers: int = 0,
    layer_scale: bool = True,
    tubelet: int = 1,
    stored: int = 0,  # rows of positions
) -> dict[str, Tensor]:
    """Random weights in timm's names, none of them at a value that would hide it."""
    torch.manual_seed(0)
    tube = (tubelet,) if tubelet > 1 else ()
    shapes: dict[str, tuple[int, ...]] = {
        "patch_embed.proj.weight": (WIDTH, channels, *tube, PATCH, PATCH),
        "patch_embed.proj.bias": (WIDTH,),
        "norm.weight": (WIDTH,),
        "norm.bias": (WIDTH,),
    }
    for i in range(DEPTH):
        for name, rows, columns in (
            ("attn.qkv", 3 * WIDTH, WIDTH),
            ("attn.proj", WIDTH, WIDTH),
            ("mlp.fc1", 4 * WIDTH, WIDTH),
            ("mlp.fc2", WIDTH, 4 * WIDTH),
        ):
            shapes[f"blocks.{i}.{name}.weight"] = (rows, columns)
            shapes[f"blocks.{i}.{name}.bias"] = (rows,)
        vectors = ["norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias"]
        vectors += ["ls1.gamma", "ls2.gamma"] if layer_scale else []
        shapes |= {f"blocks.{i}.{name}": (WIDTH,) for name in vectors}
    if registers:
        shapes["register_tokens"] = (1, registers, WIDTH)
    if stored:
        shapes["pos_embed"] = (1, stored, WIDTH)
    weights = {name: torch.randn(shape) * 0.05 for name, shape in shapes.items()}
    weights["patch_embed.proj.weight"] *= 0.02  # so faint that the LayerNorm's epsilon shows
    for name in weights:
        if "norm" in name and name.endswith("weight"):
            weights[name] += 1
    if not stored:
        axes = 3 if tubelet > 1 else 2
        bands = WIDTH // (2 * axes)
        row = torch.tensor([10000 ** (-k / bands) for k in range(bands)])
        weights["pos_embed.frequency_bands"] = row.repeat(axes, 1)
    return weights


def plain_forward(w: dict[str, Tensor], pictures: Tensor) -> Tensor:
    """Features (n, d) of one picture (c, h, w) or clip (c, t, h, w), one patch and head at a time."""
    kernel = w["patch_embed.proj.weight"]
    clip = pictures if pictures.ndim == 4 else pictures[:, None]
    kernel = kernel if kernel.ndim == 5 else kernel[:, :, None]
    step = kernel.shape[2]
    tokens = []
    for t in range(clip.shape[1] // step):
        for y in range(clip.shape[2] // PATCH):
            for x in range(clip.shape[3] // PATCH):
                tube = clip[:, t * step : (t + 1) * step, y * PATCH :, x * PATCH :]
                tube = tube[:, :, :PATCH, :PATCH].flatten()
                token = kernel.flatten(1) @ tube + w["patch_embed.proj.bias"]
                if "pos_embed" in w:
                    token = token + w["pos_embed"][0, len(tokens)]
                else:
                    bands = w["pos_embed.frequency_bands"]
                    place = (t, y, x)[-len(bands) :]
                    for axis, at in enumerate(place):
                        code = torch.cat([(at * bands[axis]).sin(), (at * bands[axis]).cos()])
                        start = axis * len(code)
                        token[start : start + len(code)] += code
                tokens.append(token)
    x = torch.stack(tokens)
    registers = w["register_tokens"][0] if "register_tokens" in w else x[:0]
    x = torch.cat([registers, x])
    for i in range(DEPTH):
        b = {name.removeprefix(f"blocks.{i}."): value for name, value in w.items()}
        q, k, v = (norm(x, b, "norm1") @ b["attn.qkv.weight"].T + b["attn.qkv.bias"]).chunk(3, 1)
        heads = []
        for qh, kh, vh in zip(q.chunk(HEADS, 1), k.chunk(HEADS, 1), v.chunk(HEADS, 1), strict=True):
            heads.append((qh @ kh.T / (WIDTH / HEADS) ** 0.5).softmax(1) @ vh)
        y = torch.cat(heads, 1) @ b["attn.proj.weight"].T + b["attn.proj.bias"]
        x = x + y * b.get("ls1.gamma", torch.ones(()))
        y = norm(x, b, "norm2") @ b["mlp.fc1.weight"].T + b["mlp.fc1.bias"]
        y = y * (1 + torch.erf(y / 2**0.5)) / 2
        y = y @ b["mlp.fc2.weight"].T + b["mlp.fc2.bias"]
        x = x + y * b.get("ls2.gamma", torch.ones(()))
    return norm(x, w, "norm")[len(registers) :]


def norm(x: Tensor, w: dict[str, Tensor], name: str) -> Tensor:
    centred = x - x.mean(1, keepdim=True)
    variance = centred.square().mean(1, keepdim=True)
    return centred / (variance + 1e-6).sqrt() * w[f"{name}.weight"] + w[f"{name}.bias"]


class Scheduler:
    """What a training pickles beside its weights: an object whose class runs code when loaded."""

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


@pytest.mark.parametrize(
    ("options", "prefix", "shape"),
    [
        ({}, "encoder.", (6, 48, 32)),
        ({"registers": 1}, "teacher_encoder.backbone.", (6, 48, 32)),
        ({"layer_scale": False, "stored": 196}, "target_encoder.", (6, 224, 224)),
        (
            {"channels": 3, "tubelet": 2, "layer_scale": False, "stored": 392},
            "target_encoder.backbone.",
            (3, 4, 224, 224),
        ),
        ({"channels": 3, "tubelet": 2, "registers": 1}, "target_encoder.backbone.", (3, 4, 32, 48)),
    ],
    ids=["mae", "dino", "ijepa", "vjepa", "vjepa-sinusoidal"],
)
def test_features_are_those_of_the_published_architecture(
    tmp_path: Path, options: dict[str, Any], prefix: str, shape: tuple[int, ...]
) -> None:
    weights = published(**options)
    save_training(tmp_path / "training.ckpt", weights, prefix)
    save_file(weights, tmp_path / "bare.safetensors")
    pictures = torch.rand(shape)
    expected = plain_forward(weights, pictures)
    for name in ("training.ckpt", "bare.safetensors"):
        found = load_sparsh(tmp_path / name)(pictures[None])[0]
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


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
    for line in (
        "blocks.1.ls2.gamma is missing",
        "blocks.1.ls2.beta is unknown",
        "blocks.0.attn.proj.bias is (3,), not (192,)",
    ):
        assert line in str(refusal.value)
    other = published()
    other["pos_embed.frequency_bands"] *= 2
    save_file(other, path)
    with pytest.raises(UserError, match="frequency_bands are not 10000"):
        load_sparsh(path)
    save_file(published(stored=100), path)
    with pytest.raises(UserError, match=r"100, 192\) positions.*224 x 224 or 320 x 240"):
        load_sparsh(path)
    assert load_sparsh(path, (160, 160)).config.image_size == (160, 160)
    save_file({"conv1.weight": torch.zeros(3)}, path)
    with pytest.raises(UserError, match=r"no patch_embed.proj.weight in it, but conv1.weight"):
        load_sparsh(path)
    for name, content in (("a.safetensors", b"no"), ("a.ckpt", b"no"), ("missing.ckpt", None)):
        if content:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=name):
            load_sparsh(tmp_path / name)

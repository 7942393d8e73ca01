"""Published checkpoints on our transformer, against a forward pass written from the specification."""

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from sparsh_files import DEPTH, plain_forward, published
from torch import Tensor

from touchgoal.encoders.backbones.sparsh_weights import load_sparsh
from touchgoal.runtime.errors import UserError


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
    with pytest.raises(UserError, match=r"100, 192\) positions, which fit neither.*224, 224\)"):
        load_sparsh(path)
    save_file({"conv1.weight": torch.zeros(3)}, path)
    with pytest.raises(UserError, match=r"no patch_embed.proj.weight in it, but conv1.weight"):
        load_sparsh(path)
    for name, content in (("a.safetensors", b"no"), ("a.ckpt", b"no"), ("missing.ckpt", None)):
        if content:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=name):
            load_sparsh(tmp_path / name)

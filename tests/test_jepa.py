"""I-JEPA and V-JEPA: what is seen and asked for, the loss by hand, learning, resumption."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from interrupted_training import killed_in_epoch
from test_mae import TOY as MAE
from test_mae import blobs
from test_self_distillation import TOY as DINO
from toy_touches import moving_blobs

from touchgoal.encoders.backbones.sparsh import Method, backbone_for, vit_for
from touchgoal.encoders.ssl.config import (
    IJEPA_PRESETS,
    VJEPA_PRESETS,
    IJepaConfig,
    MaeConfig,
    PredictorConfig,
    VJepaConfig,
)
from touchgoal.encoders.ssl.ijepa import IJepa
from touchgoal.encoders.ssl.predictor import JointEmbeddingPrediction, Predictor
from touchgoal.encoders.ssl.train import train_unlabelled
from touchgoal.encoders.ssl.vjepa import VJepa
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.runtime.errors import UserError

SMALL: dict[str, Any] = {"epochs": 3, "batch_size": 12, "momentum": 0.9}
PREDICTOR: dict[str, Any] = {"predictor_width": 24, "predictor_depth": 1, "predictor_heads": 2}
ITOY = IJepaConfig(vit="tiny", **SMALL, **PREDICTOR)
VTOY = VJepaConfig(vit="tiny", small_blocks=3, **SMALL, **PREDICTOR)
CASES: dict[Any, Any] = {
    "ijepa": (IJepa, ITOY, moving_blobs(24)),
    "vjepa": (VJepa, VTOY, moving_blobs(24, frames=4)),
}


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def build(method: Method, vit: str = "tiny") -> JointEmbeddingPrediction:
    kind, config, data = CASES[method]
    torch.manual_seed(0)
    return kind(config, backbone_for(method, vit, data.sensor, data.stride), 10)


def test_ijepa_sees_one_block_without_its_targets() -> None:
    model = build("ijepa", "compact")
    for seed in range(20):
        drawn = model.draw(16, rng(seed))
        seen, wanted = drawn["context_ids"], drawn["target_ids"]
        assert wanted.shape[:2] == (16, 4) and 8 <= wanted.shape[2] <= 20
        assert seen.shape[1] >= 10
        for own, blocks in zip(seen, wanted, strict=True):
            assert len(own.unique()) == len(own) and not torch.isin(own, blocks).any()
            for block in blocks:
                rows, columns = (block // 10).unique(), (block % 10).unique()
                assert len(rows) * len(columns) == len(block)
                assert 0.5 <= len(rows) / len(columns) <= 2


def test_vjepa_hides_tubes() -> None:
    model = build("vjepa", "compact")
    for seed in range(20):
        drawn = model.draw(16, rng(seed))
        few, many = (len(ids[0, 0]) for ids in drawn["target_ids"])
        assert few >= 2 * 8 and many >= 2 * 0.5 * 80
        for seen, wanted in zip(drawn["context_ids"], drawn["target_ids"], strict=True):
            for ids in (seen, wanted[:, 0]):
                first, second = ids.chunk(2, 1)
                assert torch.equal(first + 80, second) and first.max() < 80
            both = torch.cat([seen, wanted[:, 0]], 1).sort(1).values
            assert (both.diff(dim=1) > 0).all()


def test_the_loss_of_ijepa_is_the_smooth_distance_of_normed_tokens() -> None:
    model = build("ijepa")
    touch, drawn = CASES["ijepa"][2].touch[:3], model.draw(3, rng())
    total, count = 0.0, 0
    with torch.no_grad():
        for b in range(3):
            image = torch.cat([touch[b, 0], touch[b, 1]])[None].float()
            tokens = model.teacher.vit(image)[0]
            spread = (tokens.var(1, correction=0, keepdim=True) + 1e-5).sqrt()
            normed = (tokens - tokens.mean(1, keepdim=True)) / spread
            context_ids = drawn["context_ids"][b : b + 1]
            seen = model.backbone.vit(image, context_ids)
            for block in drawn["target_ids"][b]:
                error = (model.predictor(seen, context_ids, block[None])[0] - normed[block]).abs()
                total += torch.where(error < 1, error**2 / 2, error - 0.5).sum().item()
                count += error.numel()
    assert model(touch=touch, **drawn)["loss"].item() == pytest.approx(total / count, rel=1e-4)


def test_the_loss_of_vjepa_is_the_distance_of_normed_tokens() -> None:
    model = build("vjepa")
    touch, drawn = CASES["vjepa"][2].touch[:2], model.draw(2, rng())
    clip = touch.float().transpose(1, 2)  # channels before frames, the newest first
    losses = []
    with torch.no_grad():
        tokens = model.teacher.vit(clip)
        spread = (tokens.var(2, correction=0, keepdim=True) + 1e-5).sqrt()
        normed = (tokens - tokens.mean(2, keepdim=True)) / spread
        for context_ids, wanted in zip(drawn["context_ids"], drawn["target_ids"], strict=True):
            seen = model.backbone.vit(clip, context_ids)
            predicted = model.predictor(seen, context_ids, wanted[:, 0])
            rows = [normed[b, wanted[b, 0]] for b in range(2)]
            losses.append((predicted - torch.stack(rows)).abs().mean())
    torch.testing.assert_close(model(touch=touch, **drawn)["loss"], sum(losses) / 2)


@pytest.mark.parametrize("method", CASES)
def test_what_is_hidden_reaches_the_targets_alone(method: Method) -> None:
    model = build(method)
    touch, drawn = CASES[method][2].touch[:2].clone(), model.draw(2, rng())
    model(touch=touch, **drawn)["loss"].backward()
    assert all(p.grad is None for p in model.teacher.parameters())
    assert all(p.grad is not None for p in model.backbone.parameters())
    context_ids, wanted = (x[0] if isinstance(x, list) else x for x in drawn.values())
    with torch.no_grad():
        patches = model.backbone.vit.embed_patches(model.stacked(touch))
        before = model.predict(patches, context_ids, wanted)
        for b in range(2):
            for patch in set(range(12)) - set((context_ids[b] % 12).tolist()):
                y, x = 40 * (patch // 4), 40 * (patch % 4)
                touch[b, ..., y : y + 40, x : x + 40] += 3
        images = model.stacked(touch)
        assert not torch.allclose(model.targets(images)[0, wanted[0, 0]], before[0, 0])
        after = model.predict(model.backbone.vit.embed_patches(images), context_ids, wanted)
    torch.testing.assert_close(after, before)


@pytest.mark.parametrize(
    "config",
    [MAE, replace(MAE, bottleneck=False), replace(MAE, stacked=True), DINO, ITOY, VTOY],
    ids=["mae", "mae without bottleneck", "mae of two frames", "dino", "ijepa", "vjepa"],
)
def test_a_killed_training_ends_with_the_same_weights(config: Any, tmp_path: Path) -> None:
    single = isinstance(config, MaeConfig) and not config.stacked
    data, other = (
        blobs(24, seed) if single else moving_blobs(24, seed, 4 if config is VTOY else 2)
        for seed in (0, 1)
    )
    whole = train_unlabelled(data, data, config, tmp_path / "whole", TrainerOptions(), {})
    with killed_in_epoch(2):
        train_unlabelled(data, data, config, tmp_path / "killed", TrainerOptions(), {})
    go_on = TrainerOptions(resume=True)
    with pytest.raises(UserError, match=r"of another data set.*\(data was"):
        train_unlabelled(other, data, config, tmp_path / "killed", go_on, {})
    resumed = train_unlabelled(data, data, config, tmp_path / "killed", go_on, {})
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)
    lines = [(tmp_path / run / "metrics.jsonl").read_text() for run in ("whole", "killed")]
    assert lines[0] == lines[1]


@pytest.mark.parametrize(
    "method, paper, size",
    [
        ("ijepa", IJEPA_PRESETS["paper"], 2_967_936 - 2 * 6 * 192),
        ("vjepa", VJEPA_PRESETS["paper"], 21_894_912 - 2 * 12 * 384),
    ],
)
def test_sizes_are_the_published_ones(method: Method, paper: PredictorConfig, size: int) -> None:
    """The released predictors have LayerScale besides, two factors a block and channel."""
    vit = vit_for(method, "base", (224, 224))
    assert sum(p.numel() for p in Predictor(vit, paper).parameters()) == size

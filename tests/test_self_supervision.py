"""Learning without labels (MAE, DINO, I-JEPA, V-JEPA): losses by hand, what is hidden, collapse, resumption."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from toy_touches import SENSOR, moving_blobs

from touchgoal.control import features as ft
from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.sparsh import Method, backbone_for
from touchgoal.encoders.ssl import train
from touchgoal.encoders.ssl.config import DinoConfig, IJepaConfig, MaeConfig, VJepaConfig
from touchgoal.encoders.ssl.dino import Dino
from touchgoal.encoders.ssl.frames import TouchFrames, sample_frames
from touchgoal.encoders.ssl.jepa import IJepa, JointEmbeddingPrediction, VJepa
from touchgoal.encoders.ssl.self_distillation import SelfDistillation
from touchgoal.encoders.ssl.train import train_unlabelled
from touchgoal.encoders.ssl.validation import token_statistics
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.runtime.errors import UserError

MAE = MaeConfig(vit="tiny", decoder_width=16, decoder_depth=1, epochs=3, batch_size=16, lr=3e-3)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def blobs(count: int, seed: int) -> TouchFrames:
    """Round contacts in single frames."""
    return replace(moving_blobs(count, seed, frames=1), stride=1)


def test_the_mean_of_the_tokens_learns_where_and_how_strong(tmp_path: Path) -> None:
    train, val = blobs(256, 0), blobs(64, 1)
    config = replace(MAE, epochs=8)
    backbone = train_unlabelled(train, val, config, tmp_path, TrainerOptions(), {"data": "toy"})
    metrics = pretrained.ENCODER_FORMAT.provenance(tmp_path / "encoder")["metrics"]
    assert metrics["validation_loss"] < metrics["validation_loss_of_blank"]
    assert min(metrics[f"force_{axis}_r2"] for axis in "xyz") > 0.8
    frames = np.full((2, 120, 160, 3), 100, np.uint8)
    assert np.allclose(*backbone.embed_frames(frames, frames[0]))  # the same touch, twice


HEADS: dict[str, Any] = {"prototypes": 32, "head_width": 16, "head_bottleneck": 8}
DINO = DinoConfig(vit="tiny", epochs=3, batch_size=12, local_views=3, momentum=0.9, **HEADS)


def toy_dino(config: DinoConfig = DINO) -> Dino:
    torch.manual_seed(0)
    return Dino(config, backbone_for("dino", "tiny", SENSOR, 2), steps=10)


def test_the_loss_of_views_is_that_of_the_paper() -> None:
    """Equation 3: cross-entropy of every pair of different views, with a centred, sharpened teacher."""
    model = toy_dino(replace(DINO, batch_norm=False)).train()
    touch, drawn = moving_blobs(4).touch, model.draw(4, rng())
    model.center.normal_(generator=rng(1))
    center, images = model.center.clone(), model.backbone.stack(touch.float())
    views = [*drawn["global_ids"].unbind(1), *drawn["local_ids"].unbind(1)]
    assert len(views) == 2 + 3
    losses, scores = [], []
    for i in range(2):
        teacher = model.teacher_head(model.teacher.embed_touch(images, views[i]))
        scores.append(teacher)
        P = F.softmax((teacher - center) / 0.04, dim=1)
        for j, view in enumerate(views):
            if i != j:
                student = model.head(model.backbone.embed_touch(images, view)) / 0.1
                losses.append(-(P * student.log_softmax(1)).sum(1).mean())
    terms = model(touch=touch, **drawn)
    torch.testing.assert_close(terms["loss"], torch.stack(losses).mean())
    torch.testing.assert_close(model.center, 0.9 * center + 0.1 * torch.cat(scores).mean(0))
    model.eval()(touch=touch, **drawn)
    torch.testing.assert_close(model.center, 0.9 * center + 0.1 * torch.cat(scores).mean(0))


@pytest.mark.parametrize("reads", ["mean", "register"])
def test_the_teacher_learns_by_averaging_alone(reads: str) -> None:
    """Equals torch's AveragedModel with linearly rising momentum."""
    model = toy_dino(replace(DINO, reads=reads, momentum=0.9, final_momentum=1.0))
    oracle = AveragedModel(model.backbone, multi_avg_fn=get_ema_multi_avg_fn(0.9))
    oracle.update_parameters(model.backbone)  # the first is a copy
    optimizer = torch.optim.SGD([p for p in model.parameters() if p.requires_grad], lr=0.5)
    for step in range(3):
        model(touch=moving_blobs(4).touch, **model.draw(4, rng(step)))["loss"].backward()
        assert all(p.grad is None for p in model.teacher.parameters())
        assert all(p.grad is None for p in model.teacher_head.parameters())
        assert all(p.grad is not None for p in model.backbone.parameters())
        optimizer.step()
        oracle.multi_avg_fn = get_ema_multi_avg_fn(0.9 + 0.1 * step / 10)
        oracle.update_parameters(model.backbone)
        model.update_teacher()
    for ours, theirs in zip(model.teacher.parameters(), oracle.module.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)
    assert not torch.equal(model.teacher.vit.norm.bias, model.backbone.vit.norm.bias)


def test_codes_of_places_do_not_hide_a_collapse() -> None:
    places = torch.randn(1, 12, 16, generator=rng())
    touches = torch.randn(64, 1, 16, generator=rng(1))
    assert token_statistics(places.expand(64, -1, -1))["token_spread"] < 1e-12
    line = places + touches[:, :, :1] * torch.randn(16, generator=rng(2))
    assert token_statistics(line)["effective_rank"] == pytest.approx(1, abs=1e-3)
    full = token_statistics(places + touches.expand(-1, 12, -1))
    assert full["effective_rank"] > 12 and 0.3 < full["token_spread"] < 0.7


class Flattening(SelfDistillation):
    """A training whose last layer lets nothing of the touch through."""

    def draw(self, count: int, generator: torch.Generator) -> dict:
        return {}

    def forward(self, touch: torch.Tensor) -> dict:
        with torch.no_grad():
            self.backbone.vit.norm.weight.zero_()
            self.backbone.vit.norm.bias.fill_(0.5)
        return {"loss": (self.backbone.vit(self.backbone.stack(touch.float())) - 1).square().mean()}


def test_a_collapsed_training_saves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = moving_blobs(24)
    config = replace(DINO, epochs=1, lr=1e-6, momentum=0.0, final_momentum=0.0)
    monkeypatch.setitem(train._OBJECTIVES, DinoConfig, ("dino", Flattening))
    with pytest.raises(UserError, match=r"collapsed.* the same embedding.*raise --dino.momentum"):
        train_unlabelled(data, data, config, tmp_path, TrainerOptions(), {})
    assert not (tmp_path / "encoder").exists()
    assert "WARNING: the embeddings have collapsed" in capsys.readouterr().out


def test_moments_hold_the_true_past(tmp_path: Path) -> None:
    greys = 16 * np.arange(6, dtype=np.uint8)[:, None, None, None]
    images = np.broadcast_to(greys, (6, 240, 320, 3)).copy()
    columns = {key: images for key in ft.TACTILE} | {ft.ACTION: np.zeros((6, 8), np.float32)}
    EpisodeWriter(tmp_path).append(Episode(columns, "feel"))
    moments = sample_frames(EpisodeSet(tmp_path), SENSOR, 6, 0, (0, 2, 4))
    assert moments.touch.shape == (12, 3, 3, 120, 160) and moments.stride == 2
    ticks = moments.touch[:6, :, 0, 60, 80].round().tolist()  # a grey level of 16 is 1.0
    assert ticks == [[t, max(t - 2, 0), max(t - 4, 0)] for t in range(6)]
    single = sample_frames(EpisodeSet(tmp_path), SENSOR, 6, 0)
    assert torch.equal(single.touch, moments.touch[:, :1]) and single.stride == 1


SMALL: dict[str, Any] = {"epochs": 3, "batch_size": 12, "momentum": 0.9}
PREDICTOR: dict[str, Any] = {"predictor_width": 24, "predictor_depth": 1, "predictor_heads": 2}
IJEPA = IJepaConfig(vit="tiny", **SMALL, **PREDICTOR)
VJEPA = VJepaConfig(vit="tiny", small_blocks=3, **SMALL, **PREDICTOR)
CASES: dict[Any, Any] = {
    "ijepa": (IJepa, IJEPA, moving_blobs(24)),
    "vjepa": (VJepa, VJEPA, moving_blobs(24, frames=4)),
}


def build(method: Method, vit: str = "tiny") -> JointEmbeddingPrediction:
    kind, config, data = CASES[method]
    torch.manual_seed(0)
    return kind(config, backbone_for(method, vit, data.sensor, data.stride), 10)


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


@pytest.mark.parametrize("method", CASES)
def test_what_is_hidden_reaches_the_targets_alone(method: Method) -> None:
    model = build(method)
    touch, drawn = CASES[method][2].touch[:2].clone(), model.draw(2, rng())
    model(touch=touch, **drawn)["loss"].backward()
    assert all(p.grad is None for p in model.teacher.parameters())
    assert all(p.grad is not None for p in model.backbone.parameters())
    context_ids, wanted = (x[0] if isinstance(x, list) else x for x in drawn.values())
    with torch.no_grad():
        patches = model.backbone.vit.embed_patches(model.backbone.stack(touch.float()))
        before = model.predict(patches, context_ids, wanted)
        for b in range(2):
            for patch in set(range(12)) - set((context_ids[b] % 12).tolist()):
                y, x = 40 * (patch // 4), 40 * (patch % 4)
                touch[b, ..., y : y + 40, x : x + 40] += 3
        images = model.backbone.stack(touch.float())
        assert not torch.allclose(model.targets(images)[0, wanted[0, 0]], before[0, 0])
        after = model.predict(model.backbone.vit.embed_patches(images), context_ids, wanted)
    torch.testing.assert_close(after, before)

"""Masked autoencoding at toy size, and the reading of frozen embeddings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_touches import SENSOR, moving_blobs

from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.vit import patchify, random_masking
from touchgoal.encoders.probes.ridge import ridge_r2
from touchgoal.encoders.ssl.config import MaeConfig
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.mae import MaskedAutoencoder
from touchgoal.encoders.ssl.train import train_unlabelled
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.runtime.errors import UserError

TOY = MaeConfig(vit="tiny", decoder_width=16, decoder_depth=1, epochs=3, batch_size=16, lr=3e-3)


def blobs(count: int, seed: int) -> TouchFrames:
    """Round contacts in single frames."""
    moving = moving_blobs(count, seed, frames=1)
    return replace(moving, touch=moving.touch[:, 0], stride=1)


def test_the_mean_of_the_tokens_learns_where_and_how_strong(tmp_path: Path) -> None:
    train, val = blobs(256, 0), blobs(64, 1)
    config = replace(TOY, epochs=8)
    backbone = train_unlabelled(train, val, config, tmp_path, TrainerOptions(), {"data": "toy"})
    metrics = pretrained.ENCODER_FORMAT.provenance(tmp_path / "encoder")["metrics"]
    assert metrics["validation_loss"] < metrics["validation_loss_of_blank"]
    assert min(metrics[f"force_{axis}_r2"] for axis in "xyz") > 0.8
    frames = np.full((2, 120, 160, 3), 100, np.uint8)
    assert np.allclose(*backbone.embed_frames(frames, frames[0]))  # the same touch, twice


def test_one_visible_patch_is_enough(tmp_path: Path) -> None:
    """Eleven of twelve masked, the twelfth kept; and all of them kept, where that can be learned."""
    data, rng = blobs(16, 0), torch.Generator().manual_seed(0)
    for mask_ratio, bottleneck, seen in ((0.99, True, 1), (0.99, False, 1), (0.0, True, 12)):
        config = replace(TOY, mask_ratio=mask_ratio, bottleneck=bottleneck, epochs=1)
        model = MaskedAutoencoder(config, SENSOR)
        ids_keep = random_masking(model.backbone.config.vit, mask_ratio, 16, rng)
        assert ids_keep.shape == (16, seen)
        assert model.loss(data.touch.float(), ids_keep).isfinite()
    nothing_masked = replace(TOY, mask_ratio=0.01, bottleneck=False)
    with pytest.raises(UserError, match="masks none of 12 patches"):
        train_unlabelled(data, data, nothing_masked, tmp_path, TrainerOptions(), {})


def test_only_masked_patches_count_where_tokens_are_seen() -> None:
    torch.manual_seed(0)
    model = MaskedAutoencoder(replace(TOY, bottleneck=False), SENSOR)
    vit = model.backbone.config.vit
    touch = torch.randn(2, 3, 120, 160)
    ids_keep = random_masking(vit, 0.5, 2, torch.Generator().manual_seed(0))
    reconstructed, real = model.reconstruct(touch, ids_keep), patchify(touch, vit)
    seen = torch.zeros(reconstructed.shape[:2], dtype=torch.bool).scatter(1, ids_keep, True)
    expected = ((reconstructed - real) ** 2)[~seen].mean()
    torch.testing.assert_close(model.loss(touch, ids_keep), expected)


def test_patches_are_where_the_backbone_sees_them() -> None:
    vit = MaskedAutoencoder(TOY, SENSOR).backbone.config.vit
    image = torch.arange(120 * 160.0).view(1, 1, 120, 160).expand(1, 3, -1, -1)
    first = patchify(image, vit)[0, 1].view(3, vit.patch_size, vit.patch_size)
    size = vit.patch_size
    torch.testing.assert_close(first[0], image[0, 0, :size, size : 2 * size])


def test_ridge_reads_what_is_linear_and_nothing_else() -> None:
    torch.manual_seed(0)
    inputs, weights = torch.randn(400, 5), torch.randn(5, 1)
    targets = torch.cat([inputs @ weights + 3, torch.randn(400, 1)], 1)
    r2 = ridge_r2(inputs[:300], targets[:300], inputs[300:], targets[300:])
    assert r2[0] > 0.99 and r2[1] < 0.1

"""Masked autoencoding at toy size, and the reading of frozen embeddings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from touchgoal.control.errors import UserError
from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.vit import random_patches
from touchgoal.encoders.probes.ridge import ridge_r2
from touchgoal.encoders.ssl import mae as mae_module
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.mae import MaeConfig, MaskedAutoencoder, patchify, train_mae

TOY = MaeConfig(vit="tiny", decoder_width=16, decoder_depth=1, epochs=3, batch_size=16, lr=3e-3)


def blobs(count: int, seed: int) -> TouchFrames:
    """Round contacts somewhere on the gel; the "force" says where and how strong."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:120, :160]
    place = rng.uniform((30, 30), (90, 130), (count, 2))
    strength = rng.uniform(1, 4, count)
    distance2 = (y - place[:, 0, None, None]) ** 2 + (x - place[:, 1, None, None]) ** 2
    blob = strength[:, None, None] * np.exp(-distance2 / 20**2)
    touch = torch.from_numpy(np.repeat(blob[:, None], 3, 1)).half()
    wrench = np.column_stack([place / 100, strength, np.zeros((count, 3))])
    return TouchFrames(touch, torch.from_numpy(wrench).float())


def test_the_mean_of_the_tokens_learns_where_and_how_strong(tmp_path: Path) -> None:
    train, val = blobs(256, 0), blobs(64, 1)
    config = replace(TOY, epochs=8)
    backbone = train_mae(train, val, config, tmp_path, {"data": "toy"})
    metrics = pretrained.ENCODER.provenance(tmp_path / "encoder")["metrics"]
    assert metrics["validation_loss"] < metrics["validation_power"]
    assert min(metrics[f"force_{axis}_r2"] for axis in "xyz") > 0.8
    frames = np.full((2, 120, 160, 3), 100, np.uint8)
    assert np.allclose(*backbone.embed_frames(frames, frames[0]))  # the same touch, twice


@pytest.mark.parametrize("bottleneck", [True, False])
def test_a_killed_training_ends_with_the_same_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bottleneck: bool
) -> None:
    data, config = blobs(32, 0), replace(TOY, bottleneck=bottleneck)
    whole = train_mae(data, data, config, tmp_path / "whole", {})
    with monkeypatch.context() as patch:
        epoch = mae_module._Run.train_epoch

        def dies(run, number):
            if number == 2:
                raise KeyboardInterrupt
            return epoch(run, number)

        patch.setattr(mae_module._Run, "train_epoch", dies)
        with pytest.raises(KeyboardInterrupt):
            train_mae(data, data, config, tmp_path / "killed", {})
    resumed = train_mae(data, data, config, tmp_path / "killed", {}, resume=True)
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(UserError, match="holds a run already"):
        train_mae(data, data, config, tmp_path / "killed", {})
    with pytest.raises(UserError, match="of another data set, encoder or config"):
        train_mae(data, data, replace(config, lr=1e-3), tmp_path / "killed", {}, resume=True)


def test_only_unseen_patches_count_where_tokens_are_seen() -> None:
    torch.manual_seed(0)
    model = MaskedAutoencoder(replace(TOY, bottleneck=False))
    vit = model.backbone.config.vit
    touch = torch.randn(2, 3, 120, 160)
    ids_keep = random_patches(vit, 2, 0.5, torch.Generator().manual_seed(0))
    reconstructed, real = model.reconstruct(touch, ids_keep), patchify(touch, vit)
    seen = torch.zeros(reconstructed.shape[:2], dtype=torch.bool).scatter(1, ids_keep, True)
    expected = ((reconstructed - real) ** 2)[~seen].mean()
    torch.testing.assert_close(model.loss(touch, ids_keep), expected)


def test_patches_are_where_the_backbone_sees_them() -> None:
    vit = MaskedAutoencoder(TOY).backbone.config.vit
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


def test_an_encoder_of_the_other_kind_is_refused(tmp_path: Path) -> None:
    pretrained.save(MaskedAutoencoder(TOY).backbone, tmp_path, {})
    assert pretrained.load_encoder(tmp_path).config.sensor == "gelsight_mini_markers"
    with pytest.raises(UserError, match="is damaged"):
        pretrained.load_aligned(tmp_path)
    with pytest.raises(UserError, match="is damaged"):
        pretrained.load_touch_backbone(pretrained.SHIPPED)
